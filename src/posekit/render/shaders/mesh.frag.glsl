// Everything is computed in the mesh's own axes: the eye and the light are brought there on the CPU.
in vec3 v_position;

#ifdef COORDS
uniform vec3 centre;   // of the mesh's bounding box, obj
uniform vec4 z_row;    // third row of T_view_ctr
layout(location = COORDS) out vec4 coords;
#endif

#ifdef COLOUR
uniform vec3 eye;             // the camera's centre
uniform vec4 light_direction; // towards the light; w: shininess
uniform vec4 light_colour;    // w: ambient
uniform vec2 light_strength;  // diffuse, specular
in vec3 v_normal;
#ifdef VERTEX_COLOURS
INTERPOLATION in vec3 v_colour;
#endif
#ifdef TEXTURED
INTERPOLATION in vec2 v_uv;
uniform sampler2D surface;
#endif
layout(location = COLOUR) out vec4 rgba;

vec3 base_colour() {
#if defined(TEXTURED)
    return texture(surface, v_uv).rgb;
#elif defined(VERTEX_COLOURS)
    return v_colour;
#else
    return vec3(0.6);
#endif
}

vec3 shade(vec3 base) {
    if (light_strength == vec2(0.0)) return base * light_colour.rgb * light_colour.w;
    vec3 to_eye = normalize(eye - v_position);
    vec3 n = v_normal * inversesqrt(max(dot(v_normal, v_normal), 1e-12));
    n = dot(n, to_eye) < 0.0 ? -n : n;  // scanned meshes have faces with the wrong winding
    float diffuse = max(dot(n, light_direction.xyz), 0.0);
    vec3 lit = base * (light_colour.w + light_strength.x * diffuse);
    if (light_strength.y > 0.0 && diffuse > 0.0) {
        vec3 halfway = normalize(to_eye + light_direction.xyz);
        lit += light_strength.y * pow(max(dot(n, halfway), 0.0), light_direction.w);
    }
    return lit * light_colour.rgb;
}
#endif

#ifdef MASK
layout(location = 0) out vec4 covered;
#endif

void main() {
#ifdef COLOUR
    rgba = vec4(shade(base_colour()), 1.0);
#endif
#ifdef COORDS
    coords = vec4(v_position + centre, dot(z_row, vec4(v_position, 1.0)));
#endif
#ifdef MASK
    covered = vec4(1.0);
#endif
}
