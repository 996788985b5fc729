"""A garbage datagram changes nothing but a counter."""

import json
import random

from bench import TRACKING, Bench, need_programs
from intabs import messages

need_programs()
TICKS = 60

# Who listens to what, and so has to count what it cannot decode there.
HEARS = {
    "plant": {"LITE6_STATUS", "LITE6_COMMAND", "ESTOP", "RESET", "PLANT_CONTROL"},
    "perception": {"LITE6_STATUS"},
    "control": {"LITE6_STATUS", "OBJECT_POSES", "SKILL_PLAN", "SKILL_CONTROL"},
}


def garbage(channel: str, rng: random.Random) -> list[bytes]:
    kind = messages.CHANNELS[channel]
    fingerprint = kind._get_packed_fingerprint()
    return [
        b"",
        b"\0",
        rng.randbytes(40),
        rng.randbytes(1400),
        fingerprint,  # right type, nothing in it
        fingerprint + rng.randbytes(5),
    ]


def trajectory(tmp_path, litter: bool) -> tuple[dict[int, int], Bench]:
    """The plant's state at the first policy ticks in lockstep, as far as we heard of it: {utime: hash}."""
    rng = random.Random(3)
    with Bench(tmp_path, clock="lockstep", perception="truth") as bench:
        bench.start_all()
        bench.play()

        def far_enough() -> bool:
            if litter:
                for channel in messages.CHANNELS:
                    bench.bus.publish_raw(channel, rng.choice(garbage(channel, rng)))
            return bench.status.utime >= TICKS * 40_000

        bench.until(far_enough, f"{TICKS} ticks", patience_s=60)
        bench.processes.check()
        path = {t.utime: t.state_hash for t in bench.heard["PLANT_TRUTH"] if t.utime < TICKS * 40_000}
        return path, bench


def test_garbage_on_every_channel_leaves_the_trajectory_as_it_was(tmp_path):
    clean, bench = trajectory(tmp_path / "clean", litter=False)
    assert bench.status.refused[0] == 0
    littered, bench = trajectory(tmp_path / "littered", litter=True)
    # We drown in it ourselves and miss a message now and then; what comes later tells of the state before it.
    both = clean.keys() & littered.keys()
    assert len(both) > 0.8 * TICKS and max(both) > 0.9 * TICKS * 40_000
    assert [t for t in sorted(both) if littered[t] != clean[t]] == []
    assert bench.status.refused[0] > 0


def test_garbage_is_counted_by_whoever_listens_and_nothing_stops(tmp_path):
    rng = random.Random(5)
    with Bench(tmp_path) as bench:
        bench.start_all()
        bench.play()
        bench.until(lambda: bench.status.state == TRACKING, "the plan is played")
        session = bench.status.session
        for channel in messages.CHANNELS:
            pieces = garbage(channel, rng)
            for data in pieces:
                bench.bus.publish_raw(channel, data)
        bench.listen(0.3)
        status = bench.status
        assert (status.state, status.session) == (TRACKING, session)
        assert status.refused[0] == len(pieces)
        assert sum(status.refused[1:]) == 0
        assert set(bench.processes.stop().values()) == {0}
    for program, channels in HEARS.items():
        figures = json.loads((tmp_path / f"{program}.json").read_text())
        assert undecodable(figures) == len(pieces) * len(channels), program


def undecodable(figures: dict) -> int:
    """The counter, on whichever level the program writes it."""
    if "undecodable" in figures:
        return figures["undecodable"]
    return sum(undecodable(v) for v in figures.values() if isinstance(v, dict))
