"""The project speaks the field's language: words that it once had for things with a standard name don't come back."""

import re
import subprocess

from tests.support.processes import ROOT

RETIRED = {
    "photographs?|photographed": "image, captured",
    "stillness": "static",
    "settling": "static time window",
    "taught": "updated",
    "foretold": "predicted",
    "healed": "outliers replaced",
    "companions": "copies",
    "strains": "local rigidity",
    "shared motions?": "motion bases",
    "basis_(logits|ids|weights|count|knots|stretches)": "skinning_logits, node_ids, num_nodes, num_knots, affine",
    "warmup_fraction|still_steps|grown_steps": "static_fraction, deform_start_step, full_window_step",
    "densify_\\w+|opacity_reset_every": "refine_*, grow_*, reset_every_fraction",
    "\\w+_rate_(start|end)": "*_lr_init, *_lr_final",
    "max_error": "min_psnr",
    "delta_spaces?_raw|detach_means|embedding_size": "scale_space, detach_deform_input, embedding_dim",
    "trimmed|trimming": "pruned, pruning",
    "half_extent|floored": "scene_half_size, clamped scales",
    "doorman": "early rejection",
    "lanes_memory|lane_types|LanesType|parts?_of_lanes": "vector_memory, vector_types, VectorType, part_count",
    "serve[./]watch|stopped watch|rasterizer[./]ahead": "render_job, precompile",
    "(?:most|least)_(?!common)\\w+|at_most": "max_*, min_*",
    "[a-z]+_a_(?:byte|pair|part|round|turn|row|pixel|second)": "*_per_*",
    "anew|nobody|whoever": "again, no one, the one that",
    "pictures?|films?": "image, video",
    "truths?|judge[ds]?|lessons?": "target, evaluate, training sample",
    "hammer|giants?": "stress, huge splats",
    "wander(?:s|ing)?|faint(?:er|est)?": "noise injection, low opacity",
    "laps?|unsteady|unkind|dear": "timing run, unstable, fault injection, expensive",
}
"""Regular expressions of whole words, and what is said instead."""

THIS = "tests/ops/test_words.py"
TEXT = ("*.py", "*.md", "*.toml", "*.js", "*.html", "*.css", "*.yaml", "Makefile")
OTHER_PROGRAMS = ("docs/migration.md",)
"""Where options of other projects are named."""


def test_retired_words_stay_retired() -> None:
    listed = subprocess.run(["git", "ls-files", *TEXT], cwd=ROOT, capture_output=True, text=True, check=True).stdout
    pattern = re.compile("|".join(rf"\b(?:{word})\b" for word in RETIRED), re.IGNORECASE)
    found = [
        f"{name}:{number}: {match.group(0)}"
        for name in listed.splitlines()
        if name != THIS and name not in OTHER_PROGRAMS
        for number, line in enumerate((ROOT / name).read_text(encoding="utf-8").splitlines(), start=1)
        for match in pattern.finditer(line)
    ]
    assert not found, "\n".join(found)
