"""What the picture decoders inside OpenCV say on stderr: kept from the terminal, and listened to.

libjpeg fills what it cannot decode with gray and goes on; that it did so, it says on stderr alone.
"""

from __future__ import annotations

import os
import re
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from threading import Lock

_STDERR = 2
# libpng; libjpeg's messages (jerror.h) about data; OpenCV's log
_OURS = re.compile(
    r"libpng (error|warning): |Corrupt JPEG|Premature end of JPEG|Inconsistent progression |"
    r"Invalid (SOS|progressive|scan|component|crop|JPEG|memory) |"
    r"Warning: unknown JFIF|Application transferred too |Unknown Adobe color|Bogus |"
    r"Unsupported (JPEG|marker|color) |"
    r"Quantization table |Huffman table |Arithmetic table |Sorry, |Not a JPEG|Empty (JPEG|input)|"
    r"Maximum supported image|Too many color comp|Image too wide|\[ ?(WARN|ERROR|INFO):"
)
_DAMAGE = re.compile(
    r"Corrupt JPEG data: (?!\d+ extraneous)|Premature end of JPEG|Inconsistent progression|"
    r"Invalid SOS param|libpng error"
)
# Cameras pad the end of a picture with a few bytes; more is what is left over after an error.
_EXTRA = re.compile(r"Corrupt JPEG data: (\d+) extraneous bytes")
_MOST_EXTRA = 16

_lock = Lock()


@contextmanager
def decoder_complaints() -> Iterator[list[str]]:
    """Collect what decoders write to the process's stderr; the list is filled on leaving.

    Lines that no decoder is known to write are another thread's, and are passed on.
    """
    complaints: list[str] = []
    with _lock, tempfile.TemporaryFile() as kept:
        try:
            real = os.dup(_STDERR)
        except OSError:  # a process without stderr has nothing to be kept from
            yield complaints
            return
        os.dup2(kept.fileno(), _STDERR)
        try:
            yield complaints
        finally:
            os.dup2(real, _STDERR)
            kept.seek(0)
            for line in kept.read().splitlines(keepends=True):
                text = line.decode(errors="replace").strip()
                if _OURS.match(text):
                    complaints.append(text)
                else:
                    with suppress(OSError):
                        os.write(real, line)
            os.close(real)


def is_damage(complaint: str) -> bool:
    """Whether pixels are missing or wrong, not only something beside them."""
    extra = _EXTRA.match(complaint)
    if extra is not None:
        return int(extra[1]) > _MOST_EXTRA
    return _DAMAGE.match(complaint) is not None
