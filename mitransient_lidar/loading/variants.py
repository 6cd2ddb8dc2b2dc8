"""Mitsuba variants: search for LLVM, variant choice, plugin registration; and the turn of threads to use Mitsuba.

Where a kernel adds to an array, each thread in Dr.Jit's pool has its own copy. All other threads in the process share
one copy, and they help with kernels while they wait. Two that wait at once overwrite each other's sums and lose light.
The virtual function calls that one thread records also see the objects in a scene that another thread is still loading.
"""

from __future__ import annotations

import contextlib
import functools
import importlib
import importlib.metadata
import logging
import os
import platform
import re
import sys
import threading
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import ParamSpec, TypeVar

from mitransient_lidar.core.errors import UserError
from mitransient_lidar.core.interruption import DeferredInterrupt
from mitransient_lidar.core.processors import usable_processors

_LOG = logging.getLogger(__name__)

#: Variants that the plugins support, in the order of preference.
SUPPORTED_VARIANTS = ("cuda_ad_mono", "llvm_ad_mono")

OLDEST_USABLE_LLVM = 17  #: Dr.Jit 1.5 aborts the process with LLVM 15 and 16, and rejects older releases.

_LLVM_VARIABLE = "DRJIT_LIBLLVM_PATH"
_LLVM_WHEEL = "karellen-llvm-core"

#: Environment variables: kernels with little optimisation, and the folder of Dr.Jit's kernels.
_QUICK_VARIABLE, _CACHE_VARIABLE = "MITRANSIENT_LIDAR_QUICK_KERNELS", "DRJIT_CACHE_DIR"

#: Plugins: module below ``mitransient_lidar.plugins``, and kind. Modules are imported in this order.
PLUGIN_MODULES = {
    **dict.fromkeys(("fournier_forand", "petzold", "sea_water", "measured_phase"), ("phase", "phase")),
    "two_term_henyey_greenstein": ("phase", "phase"),
    "layered_water": ("layered_water", "medium"),
    **dict.fromkeys(("gram_charlier_dielectric", "retroreflector", "leaf", "sediment"), ("bsdfs", "bsdf")),
    "ocean_surface": ("ocean_surface", "shape"),
    **dict.fromkeys(("seabed", "canopy"), ("bottom", "shape")),
    **dict.fromkeys(("lidar_transmitter", "sun", "sky"), ("emitters", "emitter")),
    **dict.fromkeys(("pixel_fov", "multipixel_receiver"), ("receivers", "sensor")),
    "time_gated_film": ("time_gated_film", "film"),
    **dict.fromkeys(("lidar_volpath", "lidar_merging", "passive_volpath"), ("integrators", "integrator")),
}

_registered_for: str | None = None


def find_llvm() -> Path | None:
    """Return the shared LLVM library of the wheel in this environment, or None."""
    try:
        files = importlib.metadata.files(_LLVM_WHEEL) or []
    except importlib.metadata.PackageNotFoundError:
        return None
    for file in files:
        # libLLVM.so.23.1 is the library itself; libLLVM.so and libLLVM-23.so are links to it.
        if re.fullmatch(r"libLLVM\.so\.\d+(\.\d+)*", file.name):
            path = Path(str(file.locate())).resolve()
            if path.is_file():
                return path
    return None


def is_command_line() -> bool:
    """Return whether this process is the command ``mitransient-lidar``, or ``python -m mitransient_lidar``."""
    module = ("-m", "mitransient_lidar") in zip(sys.orig_argv, sys.orig_argv[1:], strict=False)
    return module or Path(sys.argv[0]).stem == "mitransient-lidar"


def llvm_advice(problem: str) -> str:
    """Return a sentence with a problem of LLVM and the packages to install."""
    return (
        f"{problem}: install LLVM {OLDEST_USABLE_LLVM} or newer "
        f"(pip install {_LLVM_WHEEL} on Linux x86-64, else the system's LLVM package) "
        f"or point {_LLVM_VARIABLE} to its shared library"
    )


def check_llvm_path(path: str) -> None:
    """Raise `UserError` if there is no shared LLVM library at a path, or its name has a release older than 17."""
    if not Path(path).is_file():
        raise UserError(llvm_advice(f"{_LLVM_VARIABLE} = {path!r} is not a file"))
    resolved = Path(path).resolve().name
    match = re.search(r"libLLVM(?:-|\.so\.|\.)(\d+)", resolved)
    if match and int(match.group(1)) < OLDEST_USABLE_LLVM:
        raise UserError(llvm_advice(f"LLVM {match.group(1)} at {path!r} does not work with Dr.Jit"))


def prepare_llvm() -> None:
    """Set the path of LLVM for Dr.Jit unless it is set; have it compile quickly where the environment says so."""
    if not os.environ.get(_LLVM_VARIABLE) and (path := find_llvm()):
        os.environ[_LLVM_VARIABLE] = str(path)
    if os.environ.get(_QUICK_VARIABLE):
        _compile_quickly()


def _compile_quickly() -> None:
    """Let LLVM omit all passes that only optimise: kernels compile in half the time and give the same bits.

    They run 7 % longer, and have a folder of their own, where other processes do not find them. Only the wheel's LLVM
    is known to have the options, and Dr.Jit must not have chosen its folder.
    """
    import ctypes

    library = os.environ.get(_LLVM_VARIABLE)
    if "drjit" in sys.modules or not library or library != str(find_llvm()):
        return
    options = (b"drjit", b"-opt-bisect-limit=0", b"-opt-bisect-verbose=0")
    ctypes.CDLL(library).LLVMParseCommandLineOptions(len(options), (ctypes.c_char_p * len(options))(*options), b"")
    os.environ.setdefault(_CACHE_VARIABLE, os.path.expanduser("~/.drjit/quick"))


def loaded_llvm() -> tuple[int, ...] | None:
    """Return the version of the LLVM that Dr.Jit has loaded, or None."""
    import drjit as dr

    if not dr.has_backend(dr.JitBackend.LLVM):
        return None
    return tuple(dr.detail.llvm_version())


def check_llvm() -> None:
    """Raise `UserError` if Dr.Jit has no LLVM, or one with which it aborts the process.

    Dr.Jit searches for LLVM once, when it is first imported; a variable that is set later has no effect.
    """
    own = os.environ.get(_LLVM_VARIABLE)
    if own:
        check_llvm_path(own)
    version = loaded_llvm()
    if version is not None and version[0] >= OLDEST_USABLE_LLVM:
        return
    problem = "Dr.Jit finds no LLVM" if version is None else f"LLVM {version[0]} does not work with Dr.Jit"
    if own and Path(own) != find_llvm():
        raise UserError(llvm_advice(f"{problem} at {_LLVM_VARIABLE} = {own!r}"))
    if find_llvm() is not None:
        raise UserError(
            f"{problem}, because mitsuba or drjit was imported before mitransient_lidar: "
            "import mitransient_lidar first, so that Dr.Jit takes the LLVM of this environment"
        )
    raise UserError(llvm_advice(problem))


def choose_variant() -> str:
    """Return the fastest supported variant that works on this machine; raise `UserError` if there is none."""
    import drjit as dr

    if dr.has_backend(dr.JitBackend.CUDA):
        return "cuda_ad_mono"
    check_llvm()
    return "llvm_ad_mono"


def limit_threads() -> None:
    """Let Dr.Jit use as many threads as this process may use processors: it respects affinity, but not quotas."""
    import drjit as dr

    if usable_processors() < dr.thread_count():
        dr.set_thread_count(usable_processors())


@contextlib.contextmanager
def several_threads() -> Iterator[None]:
    """Give Dr.Jit at least two threads for a while: with one, Mitsuba never ends reading or writing EXR files."""
    import drjit as dr

    count = dr.thread_count()
    if count >= 2:
        yield
        return
    dr.set_thread_count(2)
    try:
        yield
    finally:
        dr.set_thread_count(count)


def set_variant(name: str | None = None) -> str:
    """Set Mitsuba's variant, register the plugins, and return the name of the variant.

    `name` is ``llvm_ad_mono`` or ``cuda_ad_mono``; by default the active variant, or the fastest that works here.

    Raises UserError if the variant is not supported or does not work on this machine.
    """
    import drjit as dr
    import mitsuba as mi

    if name is None:
        name = mi.variant() if mi.variant() in SUPPORTED_VARIANTS else choose_variant()
    if name not in SUPPORTED_VARIANTS:
        raise UserError(f"variant = {name!r} is not supported: allowed are {', '.join(SUPPORTED_VARIANTS)}")
    if name.startswith("cuda") and not dr.has_backend(dr.JitBackend.CUDA):
        raise UserError(f"variant = {name!r} needs an NVIDIA GPU and driver, and Dr.Jit finds none; use llvm_ad_mono")
    if name.startswith("llvm"):
        check_llvm()
    mi.set_variant(name)
    register_plugins(None, name)
    return name


@contextlib.contextmanager
def kept() -> Iterator[None]:
    """Leave the active variant as it is found."""
    import mitsuba as mi

    former = mi.variant()
    try:
        yield
    finally:
        if former not in (None, mi.variant()):
            mi.set_variant(former)


def leave_the_gpu(what: str) -> None:
    """Go on with ``llvm_ad_mono``, and report it once, where ``cuda_ad_mono`` is active, or would be chosen.

    `what` is rendered through several Mitsuba scenes in one kernel. OptiX traces rays through the first scene only:
    light in the other scenes would be missing without a message.

    Raises UserError if there is no LLVM.
    """
    if set_variant() == "cuda_ad_mono":
        _tell_of_llvm(what)
        set_variant("llvm_ad_mono")


@functools.cache
def _tell_of_llvm(what: str) -> None:
    _LOG.warning("%s by llvm_ad_mono: a kernel of cuda_ad_mono can trace rays through one scene only", what)


def register_plugins(_old: str | None, new: str) -> None:
    """Register every plugin for the variant ``new``; Mitsuba calls this when the variant changes.

    Plugin classes derive from classes of the active variant, so that their modules are reloaded for each one.
    In unsupported variants the plugins refuse to be loaded.
    """
    global _registered_for
    if new not in SUPPORTED_VARIANTS:
        _register_refusals()
        return
    if new == _registered_for:
        return
    for name in dict.fromkeys(["bases", *(module for module, _ in PLUGIN_MODULES.values())]):
        module = f"mitransient_lidar.plugins.{name}"
        if module in sys.modules:
            importlib.reload(sys.modules[module])
        else:
            importlib.import_module(module)
    _registered_for = new


def _register_refusals() -> None:
    """Register plugins that raise `UserError` in the active variant."""
    import mitsuba as mi

    def refuse(props: mi.Properties) -> None:
        raise UserError(
            f"{props.plugin_name()} needs the variant {' or '.join(reversed(SUPPORTED_VARIANTS))}, and {mi.variant()} "
            "is active: call mitsuba.set_variant before the scene is loaded"
        )

    for name, (_, kind) in PLUGIN_MODULES.items():
        getattr(mi, f"register_{kind}")(name, refuse)


def versions() -> dict[str, str]:
    """Return the variant and the versions that a result records."""
    import drjit as dr
    import mitsuba as mi

    return {"variant": mi.variant() or "none", "mitsuba_version": mi.__version__, "drjit_version": dr.__version__}


def describe() -> dict[str, str]:
    """Return versions, variant, LLVM and GPU as printed by ``mitransient-lidar info``."""
    import drjit as dr
    import mitsuba as mi

    from mitransient_lidar._version import __version__, commit

    llvm = loaded_llvm()
    return {
        "mitransient-lidar": __version__,
        "commit": commit() or "unknown",
        "mitsuba": mi.__version__,
        "drjit": dr.__version__,
        "python": platform.python_version(),
        "variant": mi.variant() or "none",
        "LLVM": f"{'.'.join(map(str, llvm))} ({os.environ.get(_LLVM_VARIABLE, 'system')})" if llvm else "none",
        "GPU": "usable" if dr.has_backend(dr.JitBackend.CUDA) else "none",
        "threads": str(dr.thread_count()),
    }


_P = ParamSpec("_P")
_R = TypeVar("_R")

_LOOK_S = 0.1  #: Time after which a thread that waits looks for an interruption [s].


class _Turn:
    """The turn to use Mitsuba: a lock that counts how often its thread has it."""

    def __init__(self) -> None:
        self._lock, self._depth = threading.RLock(), 0

    def __enter__(self) -> bool:
        """Return whether the thread has just got the turn."""
        while not self._lock.acquire(timeout=_LOOK_S):
            DeferredInterrupt.check()
        self._depth += 1
        return self._depth == 1

    def __exit__(self, kind: type[BaseException] | None, *_error: object) -> None:
        try:
            if self._depth == 1 and kind is None and (drjit := sys.modules.get("drjit")):
                # Arrays that another thread uses later must not wait for this thread's queue.
                drjit.eval()
                drjit.sync_thread()
        finally:
            self._depth -= 1
            self._lock.release()

    def renew(self) -> None:
        """Forget other threads, which a forked process does not have."""
        self.__init__()  # type: ignore[misc]


_turn = _Turn()
os.register_at_fork(after_in_child=_turn.renew)


def alone(
    function: Callable[_P, _R], within: Callable[[], contextlib.AbstractContextManager[None]] = kept
) -> Callable[_P, _R]:
    """Return a function that runs in one thread at a time, alone among all of these functions.

    It may call others of them. The first one leaves Mitsuba's active variant as it found it (`within`). A Ctrl-C in the
    main thread ends its waiting.
    """

    @functools.wraps(function)
    def waiting(*args: _P.args, **kwargs: _P.kwargs) -> _R:
        with _turn as is_first, within() if is_first else contextlib.nullcontext():
            return function(*args, **kwargs)

    return waiting


def alone_with_scene(function: Callable[_P, _R]) -> Callable[_P, _R]:
    """Return a function as `alone` does, that leaves the variant of the scene which it returns."""
    return alone(function, contextlib.nullcontext)
