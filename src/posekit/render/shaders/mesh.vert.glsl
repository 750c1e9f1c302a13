// Positions are relative to the mesh's bounding-box centre, so that float32 stays exact far from its origin.
uniform mat4 clip_from_ctr;

in vec3 position;
out vec3 v_position;

#ifdef COLOUR
in vec3 normal;
out vec3 v_normal;
#ifdef VERTEX_COLOURS
in vec3 colour;
INTERPOLATION out vec3 v_colour;
#endif
#ifdef TEXTURED
in vec2 uv;
INTERPOLATION out vec2 v_uv;
#endif
#endif

void main() {
    gl_Position = clip_from_ctr * vec4(position, 1.0);
    v_position = position;
#ifdef COLOUR
    v_normal = normal;
#ifdef VERTEX_COLOURS
    v_colour = colour;
#endif
#ifdef TEXTURED
    v_uv = uv;
#endif
#endif
}
