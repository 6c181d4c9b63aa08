"""Output for any terminal: characters that its encoding lacks are written in ASCII."""

from __future__ import annotations

import codecs
import contextlib
import sys
import unicodedata
from collections.abc import Iterator

__all__ = ["any_terminal"]

HANDLER = "sb3_torcs.plain"
PLAIN = {"→": "->", "–": "-", "—": "-", "−": "-", "×": "x", "·": "*", "°": " deg", "’": "'"}
FIRST_BYTE, LAST_BYTE = (
    "\udc80",
    "\udcff",
)  # surrogates that stand for bytes of a path that is not valid text


def _plain(error: UnicodeError) -> tuple[str | bytes, int]:
    """Replace a character that an encoding lacks; write a byte of a path as it is."""
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
    """Let standard output and error accept any text, whatever their encoding."""
    streams = [s for s in (sys.stdout, sys.stderr) if hasattr(s, "reconfigure")]
    before = [stream.errors for stream in streams]
    for stream in streams:
        stream.reconfigure(errors=HANDLER)
    try:
        yield
    finally:
        for stream, errors in zip(streams, before, strict=True):
            stream.reconfigure(errors=errors)
