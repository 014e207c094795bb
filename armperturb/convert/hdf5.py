"""Whether an HDF5 file is whole, modest and readable, before this process reads it."""

import json
from pathlib import Path

from armperturb.convert.child import run_reader
from armperturb.convert.raw import LARGEST, require_modest

SIGNATURE = b"\x89HDF\r\n\x1a\n"
"""With which the superblock begins, at byte 0, or at 512 below MATLAB's own header."""


def require_whole_hdf5(path: Path) -> None:
    """Refuse a file that is cut off, has something behind its end, claims more than fits into memory, or is damaged.

    Another process reads it once: some damaged files crash HDF5, or make it go on for ever.

    Raises:
      ValueError: it is none of HDF5, or one of these.
      OSError: it cannot be read.
    """
    size = path.stat().st_size
    require_modest(path, size, "size")
    end, base = _end(path)
    if size < end:
        raise ValueError(f"{path}: {size} bytes; expected {end}, as its header says (the file is cut off)")
    if size > base + end:
        raise ValueError(
            f"{path}: {size} bytes; expected {end}, as its header says (something follows: two files in one?)"
        )
    try:
        claims = json.loads(run_reader("hdf5_program.py", path, str(LARGEST)))
    except ValueError as error:
        raise ValueError(f"{path}: not a readable HDF5 file ({error})") from None
    for name, claim in claims.items():
        require_modest(path, claim, f"{name!r} unpacked")
    require_modest(path, sum(claims.values()), "all of it unpacked")


def _end(path: Path) -> tuple[int, int]:
    """End and base address of the superblock."""
    with path.open("rb") as file:
        head = file.read(1024)
    start = next((at for at in (0, 512) if head[at : at + 8] == SIGNATURE), None)
    if start is None:
        raise ValueError(f"{path}: no HDF5 file (begins with {head[:8]!r}); expected netCDF4 or MATLAB v7.3")
    block = head[start:]
    # Where base and end address lie follows from the version: HDF5 file format specification, section II.A.
    first, second, width_at = {0: (24, 40, 13), 1: (28, 44, 13), 2: (12, 28, 9), 3: (12, 28, 9)}.get(
        block[8] if len(block) > 8 else -1, (0, 0, 0)
    )
    width = block[width_at] if width_at and len(block) > width_at else 0
    if width not in (4, 8) or len(block) < second + width:
        raise ValueError(f"{path}: the HDF5 superblock is damaged; expected a version of 0 to 3 and 4 or 8 bytes wide")
    if width == 4:
        first, second = {24: (24, 32), 28: (28, 36), 12: (12, 20)}[first]
    base = int.from_bytes(block[first : first + width], "little")
    return int.from_bytes(block[second : second + width], "little"), base
