"""Load an object file of LLVM's without LLVM, whose import takes longer than a warm solve.

An object file is sections, to be copied to memory, and relocations: places where an address is
missing. Code for the large model on x86-64 has two kinds of them, both 64 bits wide, with S the
address of the symbol, A an offset that the file states, and P the address of the place:

    R_X86_64_64 = S + A,    R_X86_64_PC64 = S + A - P.

What is anything else (another system, format or relocation) is left to LLVM's own loader. The
format: System V ABI, Object Files, and its AMD64 supplement.
"""

from __future__ import annotations

import ctypes
import mmap
import platform
import sys
from struct import Struct

HEADER = Struct("<16sHHIQQQIHHHHHH")
SECTION = Struct("<IIQQQQIIQQ")
SYMBOL = Struct("<IBBHQQ")
RELOCATION = Struct("<QQq")
WORD = Struct("<Q")
ELF64 = b"\x7fELF\x02\x01\x01"  # 64 bits, little-endian, version 1
RELOCATABLE, X86_64 = 1, 62  # a type of files, a machine
SYMBOLS, RELOCATIONS, NOTHING = 2, 4, 8  # types of sections: their contents; zeros
WRITTEN, LOADED = 1, 2  # flags of sections that the code writes to, that belong in memory
UNDEFINED = 0  # section of a symbol that another library has
ABSOLUTE, RELATIVE = 1, 24  # R_X86_64_64, R_X86_64_PC64
READ, EXECUTE = 1, 4  # PROT_READ, PROT_EXEC
UNWINDING = ".eh_frame"  # for exceptions, which no kernel raises


class ObjectFile:
    """The code of an object file in memory, as long as this lives; `load` makes it."""

    def __init__(self, memory: mmap.mmap, addresses: dict[str, int]) -> None:
        self._memory, self._addresses = memory, addresses

    def get_function_address(self, name: str) -> int:
        """Return where a function begins."""
        return self._addresses[name]


def load(code: bytes) -> ObjectFile | None:
    """Load an object file that this process may trust, or return None: LLVM has to load it."""
    header = HEADER.unpack_from(code) if len(code) >= HEADER.size else (b"",)
    here = sys.platform == "linux" and platform.machine() == "x86_64"
    if not here or not header[0].startswith(ELF64) or header[1:3] != (RELOCATABLE, X86_64):
        return None
    first, count, names = header[6], header[12], header[13]
    sections = [SECTION.unpack_from(code, first + i * SECTION.size) for i in range(count)]
    kept = {
        i: own
        for i, own in enumerate(sections)
        if own[2] & LOADED and _name(code, sections[names], own[0]) != UNWINDING
    }
    if any(own[2] & WRITTEN for own in kept.values()):
        return None  # the memory is for reading only
    at, size = dict[int, int](), 0
    for i, own in kept.items():  # from a page each, as aligned as LLVM would have them
        at[i], size = size, size + -(-own[5] // mmap.PAGESIZE) * mmap.PAGESIZE
    if not size:
        return None
    memory = mmap.mmap(-1, size, flags=mmap.MAP_PRIVATE | mmap.MAP_ANONYMOUS)
    base = ctypes.addressof(ctypes.c_char.from_buffer(memory))
    for i, own in kept.items():
        if own[1] != NOTHING:
            memory[at[i] : at[i] + own[5]] = code[own[4] : own[4] + own[5]]
    known = _symbols(code, sections, {i: base + start for i, start in at.items()})
    for own in sections:
        if own[1] == RELOCATIONS and own[7] in kept:
            for place in range(own[4], own[4] + own[5], RELOCATION.size):
                offset, which, addend = RELOCATION.unpack_from(code, place)
                kind, (_, target) = which & 0xFFFFFFFF, known[which >> 32]
                if target is None or kind not in (ABSOLUTE, RELATIVE):
                    return None
                offset += at[own[7]]
                value = target + addend - (base + offset if kind == RELATIVE else 0)
                WORD.pack_into(memory, offset, value & 0xFFFFFFFFFFFFFFFF)
    protect = ctypes.CDLL(None).mprotect
    protect.argtypes = (ctypes.c_void_p, ctypes.c_size_t, ctypes.c_int)
    if protect(base, size, READ | EXECUTE):
        return None
    return ObjectFile(memory, {name: address for name, address in known if name and address})


def _symbols(
    code: bytes, sections: list[tuple[int, ...]], at: dict[int, int]
) -> list[tuple[str, int | None]]:
    """Return the name and the address of each symbol; None for what is not in memory."""
    table = next((own for own in sections if own[1] == SYMBOLS), None)
    if table is None:
        return []
    found = list[tuple[str, int | None]]()
    for place in range(table[4], table[4] + table[5], SYMBOL.size):
        start, _, _, section, value, _ = SYMBOL.unpack_from(code, place)
        name = _name(code, sections[table[6]], start)
        if section == UNDEFINED:
            found.append((name, _of_process(name)))
        else:
            found.append((name, at[section] + value if section in at else None))
    return found


def _name(code: bytes, strings: tuple[int, ...], start: int) -> str:
    begin = strings[4] + start
    return code[begin : code.index(b"\0", begin)].decode()


def _of_process(name: str) -> int | None:
    """Return the address of a function of the C library, cbrt for example."""
    try:
        return ctypes.cast(getattr(ctypes.CDLL(None), name), ctypes.c_void_p).value
    except AttributeError:
        return None
