"""Scene files of every plan and layer kind, mutated as protobuf: refused with a reason or rendered finite,
in bounded memory, without opening a file.
"""

import re
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from tests.support.fuzz_scenes import DRAWN, FILES, LIMITS, hostile_file, outcome, outcomes
from tests.support.memory import measured
from tests.support.processes import ROOT
from tests.support.scene_mutations import CANARY
from tests.support.sound_scenes import sound_scenes

pytestmark = [pytest.mark.slow, pytest.mark.xdist_group("sound scenes")]  # one worker makes them

MEMORY_MEGABYTES = 64.0
"""Memory beyond that of the graph: a session of onnxruntime, the file, buffers of the kernels."""

OF_THE_SYSTEM = ("/proc/", "/sys/", "/dev/")
"""Folders that onnxruntime and Python read to learn about the processor."""


def test_a_seed_determines_the_file():
    scenes = sound_scenes()
    assert hostile_file(scenes, 7) == hostile_file(scenes, 7)
    assert len({hostile_file(scenes, seed) for seed in range(40)}) > 36


@pytest.mark.skipif(sys.platform != "linux", reason="reads the process's memory from /proc")
def test_mutated_files_are_refused_or_drawn_in_bounded_memory():
    assert {name: outcome(contents) for name, contents in sound_scenes().items()} == dict.fromkeys(
        sound_scenes(), DRAWN
    )  # compiles, too
    counted, megabytes = measured(lambda: outcomes(sound_scenes()))
    drawn = counted.pop(DRAWN)
    print(f"\n{FILES:,} files, {drawn:,} drawn, the others refused for {len(counted):,} reasons; {megabytes:.0f} MB")
    assert 0.02 * FILES < drawn < 0.6 * FILES  # mutations neither always break a file nor mostly have no effect
    assert megabytes < LIMITS.memory_bytes / 2**20 + MEMORY_MEGABYTES


@pytest.mark.skipif(shutil.which("strace") is None, reason="needs strace, which sees what native code opens")
def test_mutated_files_make_no_code_open_a_file(tmp_path: Path):
    folder, marker, trace = tmp_path / "scenes", tmp_path / "marker", tmp_path / "trace"
    marker.touch()
    folder.mkdir()
    for number, contents in enumerate(sound_scenes().values()):
        (folder / f"{number:02}.onnx").write_bytes(contents)
    program = [sys.executable, "-m", "tests.support.fuzz_scenes", str(folder), str(marker)]
    calls = "trace=open,openat,openat2,creat"
    command = ["strace", "-f", "-qq", "--seccomp-bpf", "-e", calls, "-o", str(trace), *program]  # stops at these alone
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, timeout=3600, check=False)
    if "ptrace" in done.stderr and "not permitted" in done.stderr:
        pytest.skip("strace may not trace here")
    assert done.returncode == 0, done.stderr
    opened = re.findall(r'(?:open(?:at2?)?|creat)\([^"]*"([^"]*)"', trace.read_text())
    after = opened[opened.index(str(marker)) + 1 :]
    assert len(after) < len(opened)
    assert [path for path in after if not path.startswith(OF_THE_SYSTEM)] == []
    assert not any(str(CANARY) in path for path in opened)
