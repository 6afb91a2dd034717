"""How much the fuzzers test: few cases of stored seeds, or with `make fuzz` many of fresh ones.

`MSDGS_FUZZ` is the number of cases of each fuzzer, `MSDGS_FUZZ_SEED` the first seed.
"""

import os

CASES = int(os.environ.get("MSDGS_FUZZ", "20"))
SEED = int(os.environ.get("MSDGS_FUZZ_SEED", "0"))
IS_FRESH = "MSDGS_FUZZ_SEED" in os.environ
