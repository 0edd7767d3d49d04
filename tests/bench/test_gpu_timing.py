import gc

import pytest
import torch

from oasis_warp.bench import gpu_timing
from oasis_warp.bench.gpu_timing import NotCaptured, Probe, Sample, capture, first_cause, host_clock, time_groups
from oasis_warp.bench.timing import synchronise


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
    monkeypatch.setattr(gpu_timing, "warm_up", lambda probe: 1e3 * gpu_timing.GROUP_SECONDS)
    log = []
    time_groups([Probe(lambda name=name: log.append(name), counting_clock(1.0)[0]) for name in "ab"], groups=3)
    assert "".join(log) == "aabb" + "bbaa" + "aabb"  # each once to fill the caches, then timed


def test_a_time_is_that_of_a_step(monkeypatch):
    monkeypatch.setattr(gpu_timing, "WARM_SECONDS", 0.0)
    clock, groups = counting_clock(ms=2.0)
    (sample,) = time_groups([Probe(lambda: None, clock, steps=10)], groups=4)
    assert sample.times_ms == pytest.approx((0.2,) * 4)
    assert sample.calls == 5  # of two milliseconds in ten
    assert groups[-4:] == [5] * 4
    assert sum(groups[:-4]) >= gpu_timing.WARM_CALLS


def test_slow_calls_are_timed_in_fewer_groups(monkeypatch):
    monkeypatch.setattr(gpu_timing, "LONGEST_WARM", 0.0)
    clock, _ = counting_clock(ms=500.0)
    (sample,) = time_groups([Probe(lambda: None, clock)], groups=9, seconds=4.0)
    assert (len(sample.times_ms), sample.calls) == (4, 1)  # each group with a call before it
    (sample,) = time_groups([Probe(lambda: None, clock)], groups=9, seconds=0.1)
    assert len(sample.times_ms) == 2
    (sample,) = time_groups([Probe(lambda: None, clock)], groups=9)
    assert len(sample.times_ms) == 9


def test_no_garbage_is_collected_while_the_clock_runs(monkeypatch):
    monkeypatch.setattr(gpu_timing, "LONGEST_WARM", 0.0)
    seen = []

    def clock(run, times):
        seen.append(gc.isenabled())
        return 1.0

    time_groups([Probe(lambda: None, clock)], groups=2)
    assert seen[-2:] == [False, False]
    assert gc.isenabled()
    assert gc.get_freeze_count() == 0


def test_median_and_quartiles_are_those_of_the_groups():
    sample = Sample((1.0, 2.0, 3.0, 4.0, 5.0, 6.0, 7.0), calls=1)
    assert (sample.median_ms, sample.iqr_ms) == (4.0, 4.0)


def test_a_single_group_is_refused():
    with pytest.raises(ValueError, match="groups: expected 2 or more, got 1. Quartiles need some."):
        time_groups([], groups=1)


def test_the_host_clock_counts_every_call():
    calls = []
    assert host_clock(lambda: calls.append(1), 7) > 0
    assert len(calls) == 7


def test_the_reason_is_the_first_error_and_not_what_followed():
    try:
        try:
            raise RuntimeError("operation not permitted when stream is capturing\nSearch for it.")
        except RuntimeError:
            raise ValueError("capture failed")  # noqa: B904  as torch does
    except ValueError as error:
        assert first_cause(error) == "operation not permitted when stream is capturing"
    assert first_cause(KeyError()) == "KeyError"


@pytest.mark.gpu
def test_a_graph_holds_as_many_steps_as_asked_for():
    total = torch.zeros(1000, device="cuda")
    captured = capture(lambda: total.add_(1), steps=10, warm_calls=1)
    before = float(total[0])
    captured.graph.replay()
    synchronise()
    assert float(total[0]) == before + 10
    (sample,) = time_groups([captured.probe()], groups=3)
    assert 0 < sample.median_ms < 0.1


@pytest.mark.gpu
def test_what_waits_for_the_device_is_not_captured_and_work_goes_on_afterwards():
    one = torch.ones(3, device="cuda")
    stream = torch.cuda.current_stream()
    with pytest.raises(NotCaptured):
        capture(lambda: one.sum().item())
    assert torch.cuda.current_stream() == stream
    assert float((one + 1).sum()) == 6
    assert torch.equal(capture(lambda: one + 1).results, one + 1)
