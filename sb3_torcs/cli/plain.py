"""Output for any terminal: characters that its encoding lacks are written in ASCII."""

from __future__ import annotations

import codecs
import contextlib
import os
import sys
import unicodedata
from collections.abc import Iterator

__all__ = ["any_terminal", "open_streams"]

HANDLER = "sb3_torcs.plain"
PLAIN = {"→": "->", "–": "-", "—": "-", "−": "-", "×": "x", "·": "*", "°": " deg", "’": "'"}
# Surrogates that stand for bytes of a path that is not valid text.
FIRST_BYTE, LAST_BYTE = "\udc80", "\udcff"


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


def open_streams() -> None:
    """
    Let what is written to a closed stream (``>&-``) go nowhere.

    Otherwise the next file that is opened would take the place of the stream.
    """
    missing = [name for name in ("stdin", "stdout", "stderr") if getattr(sys, name) is None]
    if not missing:
        return
    while (descriptor := os.open(os.devnull, os.O_RDWR)) <= 2:
        os.set_inheritable(descriptor, True)
    os.close(descriptor)
    for name in missing:
        setattr(sys, name, open(os.devnull, "r" if name == "stdin" else "w"))  # noqa: SIM115


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
