"""The report on skipped tests."""

from tests.support.skips import ALLOWED_SKIPS, LACKS, not_tested, unexpected


def test_only_listed_reasons_are_expected():
    assert unexpected([f"{reason}: more" for reason in ALLOWED_SKIPS]) == []
    assert unexpected(["I felt like it", "I felt like it", *ALLOWED_SKIPS]) == ["I felt like it"]
    assert unexpected([lack.reason for lack in LACKS]) == sorted(lack.reason for lack in LACKS)


def test_one_line_names_untested_parts_and_the_command_to_install_them():
    assert not_tested(list(ALLOWED_SKIPS)) == ""
    line = not_tested([lack.reason for lack in (*LACKS, LACKS[0])])
    assert "the page in a browser (2), " in line
    programs = "chromium libatomic1 nginx-light prometheus strace firefox-esr xvfb libegl1 libgl1-mesa-dri"
    makes = "tests/export/runtime/node_modules tests/export/node/node_modules"
    assert line.endswith(f"apt-get install {programs} && pip install kubernetes-validate && make {makes}")
