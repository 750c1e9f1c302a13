"""The process's one OpenGL context: EGL, the system's own, or OSMesa from a wheel.

One context and many framebuffers: a second context would silently become the current one.
``POSEKIT_GL=auto|egl|osmesa`` chooses where the caller does not.
"""

from __future__ import annotations

import ctypes
import importlib.metadata
import importlib.util
import os
import sys
import threading
import warnings
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from ctypes.util import find_library
from dataclasses import dataclass
from pathlib import Path
from types import TracebackType
from typing import Any

import moderngl

from posekit.errors import RenderError

BACKENDS = ("auto", "egl", "osmesa")
APT_COMMAND = "apt-get install libegl1 libegl-mesa0 libgl1-mesa-dri"
OSMESA_COMMAND = "pip install posekit[osmesa]"
_OSMESA_PACKAGE = "lavavu-osmesa"
_MAX_DEVICES = 8


@dataclass(frozen=True)
class Context:
    """A moderngl context, the way it was made ("egl", "osmesa" or "standalone") and its process."""

    gl: moderngl.Context
    backend: str
    pid: int


_lock = threading.RLock()
_context: Context | None = None


@contextmanager
def current(backend: str = "auto") -> Iterator[Context]:
    """The process's context, current in this thread; other threads wait.

    Made at the first call. Raises RenderError where there is no OpenGL 3.3, where the context
    already runs on another backend, or in a process forked from one that has used OpenGL.
    """
    _refuse_fork()  # before the lock, which a thread of the parent may have held
    with _lock:
        context = _get(backend)
        with context.gl:
            context.gl.gc()
            yield context


def info() -> dict[str, str]:
    """vendor, renderer, version of OpenGL and the backend ("egl", "osmesa", "standalone")."""
    with current() as context:
        gl = context.gl.info
        return {
            "vendor": str(gl["GL_VENDOR"]),
            "renderer": str(gl["GL_RENDERER"]),
            "version": str(gl["GL_VERSION"]),
            "backend": context.backend,
        }


def _get(backend: str) -> Context:
    global _context
    wanted = _wanted(backend)
    if _context is None:
        _load_triton()
        gl, name = _create(wanted)
        gl.gc_mode = "context_gc"  # objects die in whatever thread drops them; GL frees them in `current`
        _context = Context(gl, name, os.getpid())
    elif wanted not in ("auto", _context.backend):
        raise RenderError(
            f"OpenGL backend {wanted!r} was asked for, but this process already uses {_context.backend!r}; "
            "a process has one. Choose it before the first rendering."
        )
    return _context


def _refuse_fork() -> None:
    """Mesa's threads do not survive a fork: a child that drew with or beside the parent's context would hang."""
    if _context is not None and _context.pid != os.getpid():
        raise RenderError(
            f"process {os.getpid()} was forked from process {_context.pid} after that had started OpenGL, whose "
            "drivers do not survive a fork. Start workers with multiprocessing's 'spawn' or 'forkserver' method, "
            "or fork them before the first rendering."
        )


def _load_triton() -> None:
    """The library of triton, of torch's builds for NVIDIA GPUs, before Mesa's: both hold LLVM, and loaded the other way
    round, as torch and torchvision do while they read networks, triton ends the process by a segmentation fault."""
    found = importlib.util.find_spec("triton")
    for folder in (found.submodule_search_locations or ()) if found is not None else ():
        for library in Path(folder, "_C").glob("libtriton*.so"):
            with suppress(OSError):  # unusable here, and then nothing else loads it either
                ctypes.CDLL(str(library))


def _wanted(backend: str) -> str:
    """The caller's choice, else the environment's."""
    chosen = os.environ.get("POSEKIT_GL", "auto") if backend == "auto" else backend
    if chosen not in BACKENDS:
        raise RenderError(
            f"unknown OpenGL backend {chosen!r} (POSEKIT_GL or backend=): use one of {', '.join(BACKENDS)}."
        )
    return chosen


def _create(wanted: str) -> tuple[moderngl.Context, str]:
    """Try the ways that fit this system, the fastest first."""
    first: tuple[str, Callable[[], moderngl.Context]] = ("egl", _create_egl)
    if wanted == "auto" and not sys.platform.startswith("linux"):
        first = ("standalone", _create_standalone)
    ways = [way for way in (first, ("osmesa", _create_osmesa)) if wanted in ("auto", way[0])]
    failures = []
    for name, create in ways:
        try:
            gl = create()
        except RenderError as error:
            failures.append(f"{name}: {error}")
            continue
        if name == "osmesa" and wanted == "auto":
            warnings.warn(
                f"OpenGL falls back to OSMesa, a software renderer, since there is no other ({'; '.join(failures)}). "
                f"Set POSEKIT_GL=osmesa if this is wanted, else: {APT_COMMAND}",
                RuntimeWarning,
                stacklevel=2,
            )
        return gl, name
    raise RenderError(
        f"no usable OpenGL 3.3 ({'; '.join(failures)}). Install it: `{APT_COMMAND}` (as root), or `{OSMESA_COMMAND}`."
    )


def _create_standalone() -> moderngl.Context:
    try:
        return _checked(moderngl.create_context(standalone=True))
    except Exception as error:  # moderngl and glcontext raise bare Exception
        raise RenderError(str(error)) from error


def _create_egl() -> moderngl.Context:
    """The first EGL device with OpenGL 3.3; Mesa's software device comes last in EGL's list."""
    egl = find_library("EGL") or "libEGL.so.1"
    libraries = {"libegl": egl, "libgl": find_library("GL") or egl}  # libEGL hands out every function by itself
    devices = range(1 if "GLCONTEXT_DEVICE_INDEX" in os.environ else _MAX_DEVICES)
    failures: list[str] = []
    for index in devices:
        try:
            return _checked(
                moderngl.create_context(standalone=True, backend="egl", device_index=index, **libraries)  # type: ignore[arg-type]
            )
        except Exception as error:  # moderngl and glcontext raise bare Exception
            if index > 0 and (str(error) in failures[-1] or "requested device index" in str(error)):
                break  # no further device
            failures.append(f"device {index}: {error}")
    raise RenderError(", ".join(failures))


def _create_osmesa() -> moderngl.Context:
    return _checked(moderngl.create_context(context=OsMesa()))  # type: ignore[arg-type]


def _checked(gl: moderngl.Context) -> moderngl.Context:
    if gl.version_code < 330:
        version = gl.info["GL_VERSION"]
        gl.release()
        raise RenderError(f"OpenGL {version} is older than 3.3")
    return gl


class OsMesa:
    """Mesa's off-screen context from a wheel's shared library, in the shape moderngl takes.

    Raises RenderError where the wheel is not installed or its library does not load.
    """

    _ATTRIBUTES = (0x22, 0x1908, 0x30, 24, 0x33, 0x34, 0x36, 3, 0x37, 3, 0)  # RGBA, 24 bit depth, core 3.3

    def __init__(self) -> None:
        self._library = _load_osmesa()
        self._library.OSMesaCreateContextAttribs.restype = ctypes.c_void_p
        self._library.OSMesaCreateContextAttribs.argtypes = [ctypes.c_void_p, ctypes.c_void_p]
        self._library.OSMesaGetProcAddress.restype = ctypes.c_void_p
        self._library.OSMesaGetProcAddress.argtypes = [ctypes.c_char_p]
        self._library.OSMesaDestroyContext.argtypes = [ctypes.c_void_p]
        self._library.OSMesaMakeCurrent.argtypes = [ctypes.c_void_p, ctypes.c_void_p, *[ctypes.c_int] * 3]
        self._library.OSMesaMakeCurrent.restype = ctypes.c_ubyte
        attributes = (ctypes.c_int * len(self._ATTRIBUTES))(*self._ATTRIBUTES)
        self._handle: int | None = self._library.OSMesaCreateContextAttribs(attributes, None)
        if not self._handle:
            raise RenderError("OSMesa offers no OpenGL 3.3 context")
        self._buffer = (ctypes.c_ubyte * (16 * 16 * 4))()  # never drawn to; OSMesa wants one
        self.__enter__()

    def load(self, name: str) -> int:
        """The address of an OpenGL function, 0 where there is none."""
        return int(self._library.OSMesaGetProcAddress(name.encode()) or 0)

    load_opengl_function = load

    def __enter__(self) -> OsMesa:
        unsigned_byte = 0x1401
        if not self._library.OSMesaMakeCurrent(self._handle, self._buffer, unsigned_byte, 16, 16):
            raise RenderError("OSMesa's context cannot be made current")
        return self

    def __exit__(self, *_: type[BaseException] | BaseException | TracebackType | None) -> None:
        self._library.OSMesaMakeCurrent(None, None, 0, 0, 0)

    def release(self) -> None:
        """Destroy the context; a second call does nothing."""
        if self._handle:
            self._library.OSMesaDestroyContext(self._handle)
            self._handle = None


def _load_osmesa() -> Any:
    """libOSMesa by ctypes. The wheel's other libraries are loaded first, so no loader path is needed."""
    try:
        distribution = importlib.metadata.distribution(_OSMESA_PACKAGE)
    except importlib.metadata.PackageNotFoundError as error:
        raise RenderError(f"{_OSMESA_PACKAGE} is not installed") from error
    files = [file for file in distribution.files or [] if file.parent.name.endswith(".libs")]
    waiting = [str(distribution.locate_file(file)) for file in files]
    failure = "it has no libOSMesa"
    while waiting:  # each round loads those whose needs the rounds before have met
        left = []
        for path in waiting:
            try:
                library = ctypes.CDLL(path)
            except OSError as error:
                failure = str(error)
                left.append(path)
                continue
            if Path(path).name.startswith("libOSMesa"):
                return library
        if len(left) == len(waiting):
            break
        waiting = left
    raise RenderError(f"{_OSMESA_PACKAGE} {distribution.version} cannot be loaded: {failure}")
