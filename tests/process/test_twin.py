"""In-process rollouts and the processes over LCM are one system: the same seed, the same trajectory, bit for bit."""

import numpy as np
import pytest

from bench import TASK, WEIGHTS, Bench, need_programs
from intabs import _core, paths
from intabs.skills.library import Library
from intabs.skills.planner import whole

need_programs()

SEED, SPREAD = 1_000_003, 2.0
TICK_US = 40_000


def in_process(perception: str, seed: int = SEED) -> dict:
    config = str(paths.MODELS / "config/perception.yaml") if perception == "tags" else ""
    rollout = _core.Rollout(str(paths.MODELS), TASK, str(WEIGHTS), config)
    rollout.reset(seed, SPREAD)
    return rollout.run(*whole(Library.load(WEIGHTS), TASK, None).arrays(), settle_ticks=5)


@pytest.mark.parametrize("perception", ["truth", "tags"])
def test_processes_and_in_process_rollout_give_the_same_trajectory(tmp_path, perception):
    rollout = in_process(perception)
    ticks = len(rollout["q"])
    with Bench(tmp_path, clock="lockstep", perception=perception, seed=SEED, spread=SPREAD) as bench:
        bench.start_all()
        bench.play()
        bench.until(lambda: bench.status.utime >= ticks * TICK_US, f"{ticks} ticks", patience_s=120)
        q = {s.utime: s.q for s in bench.heard["LITE6_STATUS"]}
        truth = {t.utime: t for t in bench.heard["PLANT_TRUTH"]}
    got = np.array([q[(k + 1) * TICK_US] for k in range(ticks)])
    np.testing.assert_array_equal(got, rollout["q"])
    assert truth[ticks * TICK_US].state_hash % 2**64 == rollout["state_hash"]
    # And it is a comparison that can fail.
    assert not np.array_equal(in_process("truth", SEED + 1)["q"], got)
