"""LLVM IR text to functions, by llvmlite, through a cache on disk.

Compiling takes a tenth of a second, loading a cached object a millisecond, without LLVM, which
takes thirty to import (`object_file.py`). Kernels are called through ctypes, which releases the GIL
while they run: threads are enough for many models or trials (`grounded.engine`).

The cache is the user's: one file a kernel, of a header, the SHA-256 of the code, and the code. A
file that is short, damaged or of another format is not used and is replaced; a file or folder that
is not the user's, or that others may write, is not used at all. A file is written
under a temporary name and renamed, so that any number of processes may share the folder; beyond
MAX_BYTES the files that were used longest ago go. Without a cache (a read-only home) kernels are
compiled again. GROUNDED_CACHE names another folder; empty, it switches the cache off.
"""

from __future__ import annotations

import contextlib
import ctypes
import hashlib
import os
import platform
import sys
import threading
import warnings
from collections.abc import Callable, Sequence
from functools import cache
from pathlib import Path
from typing import Any

from grounded.compile.run.object_file import load
from grounded.trusted import suspicion

OPTIMISATION = 1  # of LLVM's code generator; the text is optimised as it is written
MAGIC = b"grounded kernel 1\n"
MAX_BYTES = 64 * 2**20  # of all files
KERNEL = ".kernel"  # the usual kind of file
CPU, CPU_BYTES = Path("/proc/cpuinfo"), 8192  # of Linux; more than it says of the first CPU
CPU_LINES = ("vendor_id", "cpu family", "model", "stepping", "flags", "CPU ", "Features")
_LOCK = threading.Lock()


@cache
def _host() -> tuple[str, str]:
    """CPU name and its features, as LLVM has them."""
    import llvmlite.binding as llvm

    return llvm.get_host_cpu_name(), llvm.get_host_cpu_features().flatten()


@cache
def _fits() -> str:
    """What makes code fit here: LLVM's version, the system, the CPU as Linux or LLVM tells it."""
    import llvmlite

    said = ""
    with contextlib.suppress(OSError), CPU.open() as file:
        first = file.read(CPU_BYTES).partition("\n\n")[0].splitlines()
        said = "\n".join(line for line in first if line.startswith(CPU_LINES))
    if not said:
        name, features = _host()
        said = " ".join([name, *(one for one in features.split(",") if one.startswith("+"))])
    # the same CPU may run or emulate other systems, which share a home
    return f"{llvmlite.__version__} {sys.platform} {platform.machine()} {sys.maxsize} {said}"


def _machine() -> Any:
    """The host as a target machine; an engine takes it over, so each gets its own.

    Code and constants are mapped apart, now and then by more than the 2 GB that the small code
    model reaches: then LLVM aborts, or worse. The large one addresses anything.
    """
    import llvmlite.binding as llvm

    llvm.initialize_native_target()
    llvm.initialize_native_asmprinter()
    name, features = _host()
    return llvm.Target.from_default_triple().create_target_machine(
        cpu=name, features=features, opt=OPTIMISATION, reloc="static", codemodel="large", jit=True
    )


@cache
def lanes() -> int:
    """Doubles in the widest vector of this machine, 4 or 8."""
    return 8 if "avx512f" in _fits() else 4


@cache
def writers() -> str:
    """A hash of the files that write kernels: another version of us writes another text."""
    text = hashlib.sha256()
    for path in sorted(Path(__file__).parents[1].rglob("*.py")):
        text.update(path.read_bytes())
    return text.hexdigest()[:16]


class Library:
    """Compiled functions of one module; keeps the code alive."""

    def __init__(self, loaded: Any, names: Sequence[str]) -> None:
        self._loaded = loaded
        prototype = ctypes.CFUNCTYPE(ctypes.c_int64, ctypes.c_void_p)
        self.addresses = {name: int(loaded.get_function_address(name)) for name in names}
        self.functions: dict[str, Callable[[int], int]] = {
            name: prototype(address) for name, address in self.addresses.items()
        }

    def __getitem__(self, name: str) -> Callable[[int], int]:
        return self.functions[name]


def library(key: str, write: Callable[[], str], names: Sequence[str]) -> Library:
    """The functions `names` of a module, loaded from the cache or compiled now from `write`.

    `key` identifies the text; the machine and llvmlite's version are added here.
    """
    with _LOCK:  # LLVM's global context is not thread safe
        digest = hashlib.sha256(f"{key} {_fits()}".encode()).hexdigest()
        code = stored(digest)
        if code is None:
            code = _compiled(write())
            store(digest, code)
        return Library(load(code) or _loaded(code), names)


def _compiled(text: str) -> bytes:
    """The object file of IR text."""
    import llvmlite.binding as llvm

    machine = _machine()
    module = llvm.parse_assembly(text)
    module.triple = llvm.get_process_triple()
    return bytes(machine.emit_object(module))


def _loaded(code: bytes) -> Any:
    """LLVM's own loader of an object file, with the file in it."""
    import llvmlite.binding as llvm

    machine = _machine()
    engine = llvm.create_mcjit_compiler(llvm.parse_assembly(""), machine)
    engine.add_object_file(llvm.ObjectFileRef.from_data(code))
    engine.finalize_object()
    return engine


def folder() -> Path | None:
    """Where kernels are kept; None when the cache is off."""
    chosen = os.environ.get("GROUNDED_CACHE")
    if chosen is not None:
        return Path(chosen) if chosen else None
    if sys.platform == "win32":
        base = Path(os.environ.get("LOCALAPPDATA", Path.home() / "AppData" / "Local"))
    elif sys.platform == "darwin":
        base = Path.home() / "Library" / "Caches"
    else:
        xdg = os.environ.get("XDG_CACHE_HOME", "")
        base = Path(xdg) if xdg.startswith("/") else Path.home() / ".cache"
    return base / "grounded"


def stored(digest: str, kind: str = KERNEL) -> bytes | None:
    """What is stored under a digest, or None when there is nothing that can be trusted."""
    try:
        home = folder()
        if home is None:
            return None
        path = home / f"{digest}{kind}"
        if not (path.is_file() and _own(home) and _own(path)):
            return None
        data = path.read_bytes()
        code = data[len(MAGIC) + 32 :]
        if data != MAGIC + _check(digest, code) + code:
            return None
        with contextlib.suppress(OSError):
            os.utime(path)  # used now
        return code
    except (OSError, RuntimeError):
        return None


def store(digest: str, code: bytes, kind: str = KERNEL) -> None:
    """Stores code, atomically; silently does nothing where it can't."""
    import tempfile  # only a cold process needs it

    try:
        home = folder()
        if home is None:
            return
        home.mkdir(parents=True, exist_ok=True, mode=0o700)
        if not _own(home):
            return
        handle, temporary = tempfile.mkstemp(dir=home, suffix=".part")
        try:
            with os.fdopen(handle, "wb") as file:
                file.write(MAGIC + _check(digest, code) + code)
            Path(temporary).replace(home / f"{digest}{kind}")
        except BaseException:
            with contextlib.suppress(OSError):
                Path(temporary).unlink()
            raise
        _prune(home)
    except (OSError, RuntimeError):
        return


@cache
def _own(path: Path) -> bool:
    """Whether nobody else can have put code there; said once where somebody can."""
    why = suspicion(path)
    if why:
        remedy = "make it yours alone (chown, chmod go-w), or name another in GROUNDED_CACHE"
        warnings.warn(f"the kernel cache is not used: {why}; {remedy}", stacklevel=2)
    return not why


def _check(digest: str, code: bytes) -> bytes:
    """Binds the code to its name: a file under another's name is foreign."""
    return hashlib.sha256(digest.encode() + code).digest()


def _prune(home: Path) -> None:
    """Removes the files that were used longest ago until MAX_BYTES are left."""
    entries = []
    for path in home.glob(f"*{KERNEL}"):
        with contextlib.suppress(OSError):
            status = path.stat()
            entries.append((status.st_mtime, status.st_size, path))
    total = sum(size for _, size, _ in entries)
    for _, size, path in sorted(entries):
        if total <= MAX_BYTES:
            break
        with contextlib.suppress(OSError):
            path.unlink()
            total -= size
