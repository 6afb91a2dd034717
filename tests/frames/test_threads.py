"""Work that several threads take parts of."""

import threading

import pytest

from msdgs_serve import threads
from msdgs_serve.threads import THREADS_VARIABLE, run_together


@pytest.fixture
def two_threads(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setenv(THREADS_VARIABLE, "2")
    monkeypatch.setattr(threads, "_pool", None)


def test_a_part_that_another_thread_has_is_waited_for(two_threads: None):
    caller, begun, ended = threading.get_ident(), threading.Event(), []

    def work() -> bool:
        if threading.get_ident() == caller:
            assert begun.wait(60)
            return False  # the other thread is not done
        begun.set()
        threading.Event().wait(0.1)
        ended.append(True)
        return True

    run_together(work, ())
    assert ended


def test_errors_of_other_threads_are_raised(two_threads: None):
    caller, begun = threading.get_ident(), threading.Event()

    def work() -> bool:
        if threading.get_ident() == caller:
            assert begun.wait(60)
            return False
        begun.set()
        raise MemoryError("no room for a tile")

    with pytest.raises(MemoryError, match="no room"):
        run_together(work, ())


def test_threads_without_work_are_not_awaited(two_threads: None):
    caller, begun, go_on = threading.get_ident(), threading.Event(), threading.Event()

    def work() -> bool:
        if threading.get_ident() != caller:
            begun.set()
            assert go_on.wait(60)
            return True
        return begun.wait(60)

    run_together(work, ())
    assert not go_on.is_set()
    go_on.set()


def test_one_thread_works_alone(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setenv(THREADS_VARIABLE, "1")
    calls = []
    run_together(lambda *numbers: bool(calls.append((threading.get_ident(), numbers))), (1, 2))
    assert calls == [(threading.get_ident(), (1, 2))]
