"""Where RASS_NO_SKIP is set, a test that lacks something fails."""

from __future__ import annotations

import pytest

pytest_plugins = ("pytester",)

TESTS = """
import shutil, pytest

@pytest.mark.skipif(shutil.which("no-such-program") is None, reason="tshark is not installed")
def test_of_a_program():
    pass

@pytest.fixture
def library():
    pytest.importorskip("no_such_package")

def test_of_a_package(library):
    pass

@pytest.mark.skipif(True, reason="needs ../shared/data/sitl, which is not part of the repository")
def test_of_recordings():
    pass

@pytest.mark.xfail
def test_that_is_known_to_fail():
    raise AssertionError

def test_that_passes():
    pass
"""
FILE = "import pytest\npytest.importorskip('no_such_package')\n"


@pytest.fixture
def suite(pytester: pytest.Pytester) -> pytest.Pytester:
    pytester.makeconftest("from tests.skips import pytest_make_collect_report, pytest_runtest_makereport")
    pytester.makepyfile(test_one=TESTS)
    return pytester


def test_usually_tests_skip(suite: pytest.Pytester, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("RASS_NO_SKIP", raising=False)
    suite.makepyfile(test_two=FILE)
    suite.runpytest_inprocess("-p", "no:cov").assert_outcomes(passed=1, skipped=4, xfailed=1)


def test_what_may_not_be_skipped_is_an_error_and_says_why(
    suite: pytest.Pytester, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("RASS_NO_SKIP", "1")
    result = suite.runpytest_inprocess("-p", "no:cov")
    result.assert_outcomes(passed=1, skipped=1, xfailed=1, errors=2)
    result.stdout.fnmatch_lines_random(
        [
            "may not be skipped with RASS_NO_SKIP*: tshark is not installed",
            "may not be skipped with RASS_NO_SKIP*: could not import 'no_such_package'*",
        ]
    )


def test_a_file_that_may_not_be_skipped_fails(suite: pytest.Pytester, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("RASS_NO_SKIP", "1")
    suite.makepyfile(test_two=FILE)
    result = suite.runpytest_inprocess("-p", "no:cov")
    result.assert_outcomes(errors=1)
    result.stdout.fnmatch_lines("may not be skipped with RASS_NO_SKIP*: could not import 'no_such_package'*")
