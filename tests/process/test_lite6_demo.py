"""The whole demo by way of the arm's driver: control -> driver -> wire protocol -> fake controller -> plant."""

import json

import pytest
from lite6_bench import OVERRUN, need_lite6

from bench import need_programs
from intabs import play
from intabs.errors import UserError

need_programs()
need_lite6()


@pytest.mark.parametrize("perception", ["truth", "tags"])
def test_a_learned_task_is_played_through_the_wire_protocol(tmp_path, perception):
    options = play.Options(perception=perception, clock="wall", arm="lite6", spread=0, out=tmp_path)
    for _ in range(3):
        try:
            summary, why = play.play(options, lambda *_: None)
        except UserError as e:
            pytest.fail(str(e))
        if summary.get("fault") != OVERRUN:
            break  # a machine without real time stands still for 40 ms now and then, and the arm rightly with it
    controller = json.loads((tmp_path / "logs" / "fake_lite6.json").read_text())
    assert controller["servo_requests"] > 0
    assert controller["servo_rejected"] == controller["error"] == 0
    assert summary["success"], why
    assert (tmp_path / "strip.png").exists()
    if perception == "tags":
        assert summary["perception"]["object_error_mm"]["p50"] < 1
