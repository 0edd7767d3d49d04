import gc
import subprocess
import sys
import time
from contextlib import contextmanager

import pytest
import torch

from oasis_warp.bench import timing as timing_module
from oasis_warp.bench.timing import Probe, Sample, Timed, Timing, host_clock, time_groups, time_together


def test_calls_take_turns_and_each_begins_a_round():
    log = []
    calls = [Timed(lambda name=name: log.append(name), 1) for name in "ab"]
    rounds = []
    timings = time_together(calls, repeats=2, after_round=rounds.append)
    assert "".join(log) == "aabb" + "aabb" + "bbaa"  # warm-up, then each twice a round: once to warm the caches
    assert rounds == [1, 2]
    assert [len(t.times_ms) for t in timings] == [2, 2]


def test_a_time_is_that_of_the_call_in_milliseconds():
    (timing,) = time_together([Timed(lambda: time.sleep(0.002), 1)], repeats=3)
    assert timing.fastest_ms >= 2
    assert timing.first_ms >= 2
    assert timing.median_ms < 200
    assert timing.cpu_ms < 1  # sleeping is no work


def test_every_call_has_its_threads_and_surroundings_and_they_are_not_timed():
    seen, before = [], torch.get_num_threads()

    @contextmanager
    def slow_to_prepare():
        time.sleep(0.01)
        seen.append("in")
        yield
        seen.append("out")

    call = Timed(lambda: seen.append(torch.get_num_threads()), threads=2, around=slow_to_prepare)
    (timing,) = time_together([call], repeats=2)
    assert seen[:4] == ["in", 2, 2, "out"]
    assert timing.fastest_ms < 5
    assert torch.get_num_threads() == before


def test_median_and_quartiles_are_those_of_the_times():
    times = (1.0, 2.0, 3.0, 4.0, 5.0, 6.0, 7.0)
    timing = Timing(first_ms=99.0, times_ms=times, cpu_times_ms=times)
    assert (timing.median_ms, timing.iqr_ms, timing.fastest_ms) == (4.0, 4.0, 1.0)
    assert (Sample(times).median_ms, Sample(times).iqr_ms) == (4.0, 4.0)


def test_a_single_repeat_is_refused():
    with pytest.raises(ValueError, match="repeats: expected 2 or more, got 1"):
        time_together([], repeats=1)


@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="only Linux tells")
def test_peak_memory_is_what_a_call_holds_at_once():
    # In a process of its own: what other tests left of the heap decides whether freed memory goes back at once.
    code = """
import torch
from oasis_warp.bench.timing import peak_megabytes

def run():
    first = torch.ones(10 * 2**20)  # 40 MiB: from 32 on the C library gives freed memory back at once
    second = first + 1
    del first
    return second + 1

print(peak_megabytes(run, torch.device("cpu")))
"""
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    megabytes = float(done.stdout)
    assert 79 <= megabytes <= 92


def counting_clock(ms):
    """A clock by which every call takes `ms`, and the calls that it was asked to time."""
    groups = []

    def clock(run, times):
        groups.append(times)
        for _ in range(times):
            run()
        return ms * times

    return clock, groups


def test_probes_take_turns_and_each_begins_a_round(monkeypatch):
    monkeypatch.setattr(timing_module, "warm_up", lambda probe: 1e3 * timing_module.GROUP_SECONDS)
    log = []
    time_groups([Probe(lambda name=name: log.append(name), counting_clock(1.0)[0]) for name in "ab"], groups=3)
    assert "".join(log) == "aabb" + "bbaa" + "aabb"  # each once to fill the caches, then timed


def test_a_time_is_that_of_a_step(monkeypatch):
    monkeypatch.setattr(timing_module, "WARM_SECONDS", 0.0)
    clock, groups = counting_clock(ms=2.0)
    (sample,) = time_groups([Probe(lambda: None, clock, steps=10)], groups=4)
    assert sample.times_ms == pytest.approx((0.2,) * 4)
    assert sample.calls == 5  # of two milliseconds in ten
    assert groups[-4:] == [5] * 4
    assert sum(groups[:-4]) >= timing_module.WARM_CALLS


def test_slow_calls_are_timed_in_fewer_groups(monkeypatch):
    monkeypatch.setattr(timing_module, "LONGEST_WARM", 0.0)
    clock, _ = counting_clock(ms=500.0)
    (sample,) = time_groups([Probe(lambda: None, clock)], groups=9, seconds=4.0)
    assert (len(sample.times_ms), sample.calls) == (4, 1)  # each group with a call before it
    (sample,) = time_groups([Probe(lambda: None, clock)], groups=9, seconds=0.1)
    assert len(sample.times_ms) == 2
    (sample,) = time_groups([Probe(lambda: None, clock)], groups=9)
    assert len(sample.times_ms) == 9


def test_no_garbage_is_collected_while_the_clock_runs(monkeypatch):
    monkeypatch.setattr(timing_module, "LONGEST_WARM", 0.0)
    seen = []

    def clock(run, times):
        seen.append(gc.isenabled())
        return 1.0

    time_groups([Probe(lambda: None, clock)], groups=2)
    assert seen[-2:] == [False, False]
    assert gc.isenabled()
    assert gc.get_freeze_count() == 0


def test_a_single_group_is_refused():
    with pytest.raises(ValueError, match="groups: expected 2 or more, got 1. Quartiles need some."):
        time_groups([], groups=1)


def test_the_host_clock_counts_every_call():
    calls = []
    assert host_clock(lambda: calls.append(1), 7) > 0
    assert len(calls) == 7
