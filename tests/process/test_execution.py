"""What the command line says of plans is what the programs then do: compositions, goals from a file, trials."""

import json
import subprocess
import sys

import pytest

from bench import need_programs
from intabs import messages
from intabs.play import NO_EFFECT, _Run

need_programs()


def intabs(*args: object) -> subprocess.CompletedProcess:
    code = "import sys; from intabs.cli import run; sys.exit(run(sys.argv[1:]))"
    return subprocess.run([sys.executable, "-c", code, *map(str, args)], capture_output=True, text=True, timeout=300)


def test_two_tasks_that_nobody_demonstrated_together_are_done_one_after_the_other(tmp_path):
    done = intabs("compose", "drawer_open", "pick_place", "--perception", "truth", "--out", tmp_path)
    assert done.returncode == 0, done.stderr
    summary = json.loads((tmp_path / "summary.json").read_text())
    assert summary["success"] and all(s["success"] for s in summary["subtasks"])
    assert summary["plan"]["ended_from_goal_m"] < 0.05
    assert "drawer_open: demo_" in done.stdout.splitlines()[0] and (tmp_path / "strip.png").exists()


def test_a_goal_file_is_planned_for_told_of_and_reached(tmp_path):
    planned = intabs("plan", "--goal", "pick_place", "--seed", 5, "--json", tmp_path / "plan.json")
    assert planned.returncode == 0, planned.stderr
    end = json.loads((tmp_path / "plan.json").read_text())["predicted"]["0"][:3]
    goal = tmp_path / "goal.json"
    goal.write_text(json.dumps({"goals": [{"object": 0, "p_WO": end}]}))
    world = ("--goal", goal, "--task", "pick_place", "--seed", 5)
    done = intabs("plan", *world, "--run", "--perception", "truth", "--out", tmp_path / "out")
    assert done.returncode == 0, done.stderr
    assert done.stdout.index("object 0 should end at") < done.stdout.index("success after")
    assert json.loads((tmp_path / "out" / "summary.json").read_text())["plan"]["ended_from_goal_m"] < 0.03

    goal.write_text(json.dumps({"goals": [{"object": 0, "p_WO": [-0.9, -0.9, 1.5]}]}))
    refused = intabs("plan", *world)
    assert refused.returncode == 1 and refused.stderr.count("\n") == 1 and "m from it" in refused.stderr


def test_success_is_the_goals_of_a_file_and_not_the_worlds_task(tmp_path):
    """The block where the marker is not: the task is done, the goal is not reached."""
    goal = tmp_path / "goal.json"
    goal.write_text(json.dumps({"goals": [{"object": 0, "p_WO": [0.28, 0.01, 0.02]}]}))
    done = intabs("plan", "--goal", goal, "--task", "pick_place", "--run", "--perception", "truth", "--out", tmp_path)
    assert done.returncode == 1 and "mm from the goal" in done.stderr.splitlines()[-1]
    summary = json.loads((tmp_path / "summary.json").read_text())
    assert not summary["success"] and summary["plan"]["ended_from_goal_m"] > 0.03
    assert all(s["success"] for s in summary["subtasks"])


@pytest.mark.parametrize("there", [False, True])
def test_what_the_player_missed_counts_if_the_world_has_it(there):
    run = _Run(1, lockstep=True, by_time=False)
    for end_reason, utime in ((1, 0), (NO_EFFECT, 1_000_000)):
        m = messages.skill_status_t()
        m.plan_id, m.end_reason, m.utime = 1, end_reason, utime
        run.on_skill(m)
    for frame in range(50):
        m = messages.plant_truth_t()
        m.frame_seq, m.utime, m.success = frame, frame * 100_000, there
        run.on_truth(m)
    assert run.end(60.0)[1] == there


@pytest.mark.parametrize("how, good", [(["--plan", "whole"], 2), (["--ablate", "objects"], 0), (["--ablate", "z"], 0)])
def test_trials_of_the_command_line(tmp_path, how, good):
    figures = tmp_path / "figures.json"
    done = intabs("rollout", "--task", "pick_place", "--trials", 2, "--perception", "truth", "--json", figures, *how)
    assert done.returncode == 0 and f"{good} of 2 succeeded" in done.stdout, done.stderr
    assert json.loads(figures.read_text())["success"] == good


def test_the_library_is_listed_and_a_skill_is_shown(tmp_path):
    listed = intabs("skills", "list")
    assert listed.returncode == 0 and "pick_place" in listed.stdout and "demo_" in listed.stdout
    shown = intabs("skills", "show", 12, "--out", tmp_path / "skill.svg")
    assert shown.returncode == 0 and (tmp_path / "skill.svg").read_text().startswith("<svg"), shown.stderr
    assert intabs("skills", "show", 99999).returncode == 1
