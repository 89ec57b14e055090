"""A slice of `make fuzz` in every run of the tests, and what the fuzzing itself must notice."""

import random
import time

import pytest

from tests.fuzz.__main__ import parts
from tests.fuzz.framework import Part, case, fuzz

IN_A_TEST = 60


@pytest.mark.parametrize("name", parts())
def test_odd_inputs_are_taken_or_refused(name):
    tally = fuzz(parts()[name], range(IN_A_TEST), seed=2026)
    assert not tally.failures, tally.failures[0]
    assert tally.outcomes.total() == IN_A_TEST
    assert len(tally.outcomes) > 1  # inputs that are all refused would test little


def odd_part(run):
    return Part("odd", lambda rng: rng.random(), run)


def test_a_case_depends_on_its_number_alone():
    part = odd_part(str)
    assert case(part, 0, 7) == case(part, 0, 7)
    assert len({case(part, seed, number) for seed in (0, 1) for number in (7, 8)}) == 4


def test_what_raises_is_a_failure_that_names_its_number():
    def run(odd):
        if odd == case(part, 0, 3):
            raise KeyError("third")
        return "taken"

    part = odd_part(run)
    tally = fuzz(part, range(5), 0)
    assert tally.outcomes == {"taken": 4, "FAILED: KeyError": 1}
    assert [number for number, _ in tally.failures] == [3]
    assert "KeyError: 'third'" in tally.failures[0][1]


def test_what_takes_too_long_or_too_much_is_a_failure(monkeypatch):
    monkeypatch.setattr("tests.fuzz.framework.SECONDS", 0.2)

    def compute_on(odd):
        ends = time.monotonic() + 20.0
        while time.monotonic() < ends:
            random.random()
        return "taken"

    assert fuzz(odd_part(compute_on), range(1), 0).outcomes == {"FAILED: TooSlowError": 1}
    too_much = fuzz(odd_part(lambda odd: str(len(bytearray(2 << 30)))), range(1), 0)
    assert too_much.outcomes == {"FAILED: MemoryError": 1}
