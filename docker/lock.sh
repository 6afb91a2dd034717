#!/usr/bin/env bash
# Renews docker/requirements/*.txt: the pins of constraints.txt with the hashes of every file that an index has for
# them. Needs uv (`pip install uv`).
set -euo pipefail
cd "$(dirname "$0")/.."

into=docker/requirements
lock() {
    local name=$1
    shift
    uv pip compile --quiet --constraint constraints.txt --universal --python-version 3.11 --generate-hashes \
        --no-header --no-annotate --output-file "$into/$name.txt" "$@"
}

lock build "$into/build.in"
lock npm "$into/npm.in"
lock serve pyproject.toml --extra video
# torch comes from an index of its own, with other hashes; here are only the packages that it needs
lock train pyproject.toml "$into/torch_needs.in" --extra train --extra export --override "$into/no_torch.in"
