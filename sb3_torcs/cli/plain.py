"""Output that fits any terminal: what its encoding lacks is written with plain letters."""

from __future__ import annotations

import codecs
import contextlib
import sys
import unicodedata
from collections.abc import Iterator

__all__ = ["any_terminal"]

HANDLER = "sb3_torcs.plain"
PLAIN = {"→": "->", "–": "-", "—": "-", "−": "-", "×": "x", "·": "*", "°": " deg", "’": "'"}
FIRST_BYTE, LAST_BYTE = "\udc80", "\udcff"  # how Python holds the bytes of a path that is no text


def _plain(error: UnicodeError) -> tuple[str | bytes, int]:
    """Replace one character that an encoding lacks; of a path, give back the byte."""
    if not isinstance(error, UnicodeEncodeError):
        raise error
    sign, after = error.object[error.start], error.start + 1
    if FIRST_BYTE <= sign <= LAST_BYTE:
        return bytes([ord(sign) - 0xDC00]), after
    alike = unicodedata.normalize("NFKD", sign).encode("ascii", "ignore").decode()
    return PLAIN.get(sign) or alike or sign.encode("ascii", "backslashreplace").decode(), after


codecs.register_error(HANDLER, _plain)


@contextlib.contextmanager
def any_terminal() -> Iterator[None]:
    """Let standard output and error take every text for a while, whatever their encoding."""
    streams = [s for s in (sys.stdout, sys.stderr) if hasattr(s, "reconfigure")]
    before = [stream.errors for stream in streams]
    for stream in streams:
        stream.reconfigure(errors=HANDLER)
    try:
        yield
    finally:
        for stream, errors in zip(streams, before, strict=True):
            stream.reconfigure(errors=errors)
