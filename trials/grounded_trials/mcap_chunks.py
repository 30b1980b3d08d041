"""The compressions a chunk may have: none, lz4, zstd; decompressed to its stated size, never more.

The libraries are imported when the first chunk needs them.
"""

from __future__ import annotations


class BadChunk(Exception):
    """Why a chunk can't be read; the walk over the file says where."""


def decompress(compression: str, data: bytes, size: int, limit: int) -> bytes:
    """The content of a chunk.

    Args:
        compression: "", "lz4" or "zstd".
        data: the compressed bytes.
        size: the size that the chunk states for its content [bytes].
        limit: the largest size that is accepted [bytes].

    Raises:
        BadChunk: for another compression, a size beyond the limit, or content of another size.
    """
    if size > limit:
        raise BadChunk(f"it claims {size} bytes when decompressed, the limit is {limit}")
    if compression == "":
        content = data
    elif compression == "zstd":
        content = _zstd(data, size)
    elif compression == "lz4":
        content = _lz4(data, size)
    else:
        raise BadChunk(f"its compression '{compression}' is not one of zstd, lz4 and none")
    if len(content) != size:
        raise BadChunk(f"it holds {len(content)} bytes, not the {size} that it states")
    return content


def _zstd(data: bytes, size: int) -> bytes:
    import zstandard

    decoder = zstandard.ZstdDecompressor(max_window_size=2**27)
    try:
        with decoder.stream_reader(data) as reader:
            content: bytes = reader.read(size + 1)
    except zstandard.ZstdError as error:
        raise BadChunk(f"it can't be decompressed ({error})") from None
    return content


def _lz4(data: bytes, size: int) -> bytes:
    from lz4.frame import LZ4FrameDecompressor

    decoder = LZ4FrameDecompressor()
    try:
        content: bytes = decoder.decompress(data, max_length=size + 1)
    except (RuntimeError, EOFError, ValueError, MemoryError) as error:
        raise BadChunk(f"it can't be decompressed ({error})") from None
    return content


def decompress_part(compression: str, data: bytes, limit: int) -> bytes:
    """What can still be decompressed of a chunk whose end is missing, at most `limit` bytes."""
    if compression == "zstd":
        return _zstd_part(data, limit)
    if compression == "lz4":
        return _lz4_part(data, limit)
    return data[:limit] if compression == "" else b""


def _zstd_part(data: bytes, limit: int) -> bytes:
    import zstandard

    parts: list[bytes] = []
    decoder = zstandard.ZstdDecompressor(max_window_size=2**27)
    with decoder.stream_reader(data) as reader:
        try:
            while sum(map(len, parts)) < limit and (part := reader.read(2**17)):
                parts.append(part)
        except zstandard.ZstdError:
            pass
    return b"".join(parts)


def _lz4_part(data: bytes, limit: int) -> bytes:
    from lz4.frame import LZ4FrameDecompressor

    decoder, parts = LZ4FrameDecompressor(), []
    try:
        for start in range(0, len(data), 2**12):
            parts.append(decoder.decompress(data[start : start + 2**12], max_length=limit))
    except (RuntimeError, EOFError, ValueError, MemoryError):
        pass
    return b"".join(parts)[:limit]
