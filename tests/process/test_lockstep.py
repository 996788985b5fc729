"""Lockstep: the same seed gives the same run; under --perception tags nobody in the control path hears the truth."""

import copy

import pytest

from bench import Bench, need_programs
from intabs import play

need_programs()

TIMINGS = {"latency_us", "infer_us", "fps", "detect_ms"}

LIE = -7  # a state hash


def without_timings(figures):
    if isinstance(figures, dict):
        return {k: without_timings(v) for k, v in figures.items() if k not in TIMINGS}
    return figures


@pytest.mark.parametrize("perception", ["tags", "truth"])
def test_the_same_seed_twice_gives_the_same_summary(tmp_path, perception):
    summaries = []
    for n in range(2):
        options = play.Options(perception=perception, seed=3, out=tmp_path / str(n))
        summaries.append(without_timings(play.play(options, lambda *_: None)[0]))
    assert summaries[0] == summaries[1]
    assert summaries[0]["control"]["ticks"] > 50
    if perception == "tags":
        assert summaries[0]["perception"]["object_error_mm"]["p50"] < 10


def commands(tmp_path, perception: str, forge: bool, ticks: int) -> dict[int, list[float]]:
    """{time: q_target} of a run in which somebody may tell lies on PLANT_TRUTH: ahead of the plant, and newer than what
    it is going to say, each object 10 cm away."""
    with Bench(tmp_path, clock="lockstep", perception=perception) as bench:

        def lie(_answered) -> None:
            lied = copy.deepcopy(next(t for t in reversed(bench.heard["PLANT_TRUTH"]) if t.state_hash != LIE))
            lied.state_hash = LIE
            lied.p_WO = [(x + 0.1, y, z) for x, y, z in lied.p_WO]
            lied.frame_seq, lied.seq, lied.utime = lied.frame_seq + 1, lied.seq + 1, lied.utime + 40_001
            bench.bus.publish("PLANT_TRUTH", lied)

        bench.start_all()
        if forge:
            bench.bus.subscribe("LITE6_COMMAND", lie)
        bench.play()
        bench.until(lambda: bench.status.utime >= ticks * 40_000, f"{ticks} ticks", patience_s=60)
        return {c.utime: c.q_target for c in bench.heard["LITE6_COMMAND"] if c.utime < ticks * 40_000}


def test_lies_on_plant_truth_do_not_reach_control_under_tags(tmp_path):
    honest = commands(tmp_path / "a", "tags", forge=False, ticks=25)
    lied_to = commands(tmp_path / "b", "tags", forge=True, ticks=25)
    assert len(honest) >= 24
    assert lied_to == honest


def test_lies_on_plant_truth_do_reach_control_under_truth(tmp_path):
    """The test above can fail: where the truth is listened to, the lies change the commands."""
    honest = commands(tmp_path / "a", "truth", forge=False, ticks=25)
    lied_to = commands(tmp_path / "b", "truth", forge=True, ticks=25)
    assert lied_to != honest
