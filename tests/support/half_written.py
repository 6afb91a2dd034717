"""`python -m tests.support.half_written FILE`: a process that is writing a file until it is killed."""

import sys
import time
from pathlib import Path

from msdgs_serve.writing import replacing

if __name__ == "__main__":
    with replacing(Path(sys.argv[1])) as temporary:
        temporary.write_text("half")
        print("writing", flush=True)
        time.sleep(3600)
