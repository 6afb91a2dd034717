"""A program that converts .ksplat to PLY with gaussforge, whose native code crashes on damaged files."""

import resource
import sys
from pathlib import Path

import gaussforge


def main(file: Path, ply: Path, memory: int) -> None:
    """Write `ply`, or exit with the error of `file`, within `memory` bytes of address space."""
    _, most = resource.getrlimit(resource.RLIMIT_AS)
    resource.setrlimit(resource.RLIMIT_AS, (memory, most))
    made = gaussforge.GaussForge().convert(file.read_bytes(), "ksplat", "ply")
    if "error" in made:
        sys.exit(made["error"])
    ply.write_bytes(made["data"])


if __name__ == "__main__":
    main(Path(sys.argv[1]), Path(sys.argv[2]), int(sys.argv[3]))
