"""The skill library, plans and rollouts in the head, on weights trained for a few steps on recordings of the plant."""

import json
import shutil

import numpy as np
import pytest

torch = pytest.importorskip("torch")

from test_learning import SMALL, record  # noqa: E402

from intabs import _core, paths  # noqa: E402
from intabs.data.demos import save_demos  # noqa: E402
from intabs.errors import UserError  # noqa: E402
from intabs.evaluate.metrics import sample  # noqa: E402
from intabs.rollout import displaced_cm, rollout  # noqa: E402
from intabs.skills.library import EFFECT, TURN_LENGTH, Frame, Library, drawing  # noqa: E402
from intabs.skills.planner import (  # noqa: E402
    APART,
    CANDIDATES,
    FORGIVEN,
    KEPT,
    Effect,
    Goal,
    Planner,
    as_good,
    goals_of,
    load_goals,
    missing,
    seen_from,
    whole,
)
from intabs.skills.practice import practise, unsure, worth  # noqa: E402
from intabs.train.export import export, load_weights  # noqa: E402
from intabs.train.trainer import Trainer, load_config  # noqa: E402


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    """(weights, demonstrations)."""
    folder = tmp_path_factory.mktemp("skills")
    demos = [record(seed) for seed in range(4)]
    save_demos(folder / "d.hdf5", demos, {"task": "pick_place"}, valid_share=0.25)
    Trainer(load_config("intabs-small", SMALL), folder / "d.hdf5", folder / "run", 0, "cpu").train()
    export(folder / "run", folder / "weights", trials=0)
    return folder / "weights", demos


@pytest.fixture(scope="module")
def library(made):
    return Library.load(made[0])


@pytest.fixture(scope="module")
def scene(made):
    session = _core.Session(str(paths.MODELS), "pick_place", "")
    session.reset(77, 2.0)
    return seen_from(session.observe())


def test_the_library_holds_each_training_demonstration_from_its_first_to_its_last_tick(library, made):
    assert len(library.chains) == 3 and library.tasks == ["pick_place"]
    lengths = {len(d) - 1 for d in made[1]}
    for chain in library.chains.values():
        assert [s.number for s in chain] == list(range(len(chain)))
        assert sum(s.ticks for s in chain) in lengths
        assert all(s.min_ticks <= s.ticks <= s.max_ticks and s.min_ticks + s.max_ticks == 2 * s.ticks for s in chain)
        for a, b in zip(chain, chain[1:], strict=False):
            np.testing.assert_allclose(a.frames[-1].q, b.frames[0].q)
        # The block is carried by more than what the player demands, the goal never moves.
        assert max(s.moved[0] for s in chain) > EFFECT > max(s.moved[1] for s in chain)
        assert any("gripper closes" in s.effect for s in chain) and any("gripper opens" in s.effect for s in chain)
    assert "<svg" in drawing(library.skills[0]) and "above" in drawing(library.skills[0])


def test_cpp_imagines_what_torch_does(made, library):
    weights, demos = made
    model, _ = load_weights(weights)
    state = sample(demos[0]).state
    plans = [whole(library, "pick_place", None).skills, list(library.chains.values())[1][:3]]
    head = _core.KinematicRollout(str(weights), 2)
    first = Frame(
        demos[0].joint_pos[0], bool(demos[0].gripper[0]), demos[0].object_pose[0], demos[0].object_valid[0] > 0
    )
    pose, known = np.zeros((4, 7)), np.zeros(4, bool)
    pose[:, 3] = 1
    n = first.object_pose.shape[0]
    pose[:n], known[:n] = first.object_pose, first.known
    got = head.run(first.q, first.gripper_closed, pose, known,
                   [np.stack([s.z for s in p]) for p in plans], [[s.ticks for s in p] for p in plans])  # fmt: skip
    for i, plan in enumerate(plans):
        ticks = np.array([s.ticks for s in plan])
        z = torch.from_numpy(np.repeat(np.stack([s.z for s in plan]), ticks, 0))[None]
        age = torch.from_numpy(np.concatenate([np.arange(t) for t in ticks]).astype("f4"))[None]
        lasts = torch.from_numpy(np.repeat(ticks, ticks).astype("f4"))[None]
        with torch.no_grad():
            rolled, _ = model.rollout(state[:1], z, age, lasts)
        steps = int(ticks.sum())
        assert np.ptp(rolled.agent[0, :, :6].numpy(), axis=0).max() > 0.01  # something moves
        np.testing.assert_allclose(got["q"][i, :steps], rolled.agent[0, :, :6], atol=2e-3)
        np.testing.assert_allclose(got["object_pose"][i, :steps, :2, :3], rolled.p[0, :, :2], atol=2e-3)
        assert np.ptp(got["q"][i, steps - 1 :], axis=0).max() == 0  # a plan that is over stays


def test_the_demonstration_that_began_most_like_now_is_played(library):
    for (task, source), chain in library.chains.items():
        assert whole(library, task, chain[0].frames[0]).about == f"{task}: {source}"
    both = whole(library, "pick_place+pick_place", None)
    assert len(both.skills) == 2 * len(both.skills[: len(both.skills) // 2])
    with pytest.raises(UserError, match="known are pick_place"):
        whole(library, "nosuch", None)


def test_an_effect_is_carried_over_to_where_the_objects_lie(library):
    chain = next(iter(library.chains.values()))
    effect = Effect(chain)
    assert effect.moved == [0] and effect.brought_to == {0: 1}
    pose = chain[0].frames[0].object_pose.copy()
    np.testing.assert_allclose(effect.on(pose)[-1, 0, :3], chain[-1].frames[-1].object_pose[0, :3], atol=1e-6)
    pose[1, :2] += 0.05, -0.03  # the goal lies elsewhere: so does the block's end
    np.testing.assert_allclose(
        effect.on(pose)[-1, 0, :2], chain[-1].frames[-1].object_pose[0, :2] + [0.05, -0.03], atol=1e-6
    )


def test_goals_are_to_be_reached_in_their_order_and_the_last_of_an_object_at_the_end():
    path = np.zeros((4, 1, 7))
    path[..., 3] = 1
    path[:, 0, 0] = 0, 0.1, 0.2, 0.05
    there, end = (Goal(0, np.array([x, 0, 0, 1, 0, 0, 0.0])) for x in (0.2, 0.05))
    assert missing([there, end], path) == (0.0, 2)
    far, reached = missing([end, there], path)
    assert reached == 1 and abs(far - 0.15 / 2) < 1e-9


def test_a_plan_is_found_for_a_goal_and_for_what_a_task_leaves_behind(made, library, scene):
    planner = Planner(made[0])
    goals = goals_of(library, "pick_place", scene)
    assert [g.slot for g in goals] == [0]
    assert np.linalg.norm(goals[0].pose[:2] - scene.object_pose[1, :2]) < 0.02  # on the goal
    plan = planner.find(goals, scene)
    assert plan.predicted.shape == (4, 7) and np.isfinite(plan.missing) and len(plan.skills) > 2
    with pytest.raises(UserError, match="object 3, which is not seen"):
        planner.find([Goal(3, goals[0].pose)], scene)


def test_a_plan_does_not_lead_the_arm_through_what_it_does_not_concern(made, scene):
    planner = Planner(made[0])
    goals = goals_of(planner.library, "pick_place", scene)
    plan = planner.find(goals, scene)
    way = made[1][0].joint_pos
    pose, known = scene.object_pose.copy(), scene.known.copy()
    known[2] = True  # a stranger
    effects = [e for e in planner.effects if e.chain == plan.skills]
    for offset, meets in (([0, 0, 0.5], False), ([0, 0, 0.03], True)):
        pose[2, :3] = planner.arm.tip(way[len(way) // 2])[:3] + offset
        there = Frame(scene.q, scene.gripper_closed, pose, known)
        assert planner._meets(effects, there, way, np.repeat(pose[None], len(way), 0)) == meets
    effects[0].concerns.add(2)
    assert not planner._meets(effects, there, way, np.repeat(pose[None], len(way), 0))
    down = way + np.linspace(0, 1, len(way))[:, None] * [0, 1.2, 0, 0, 0, 0]  # the shoulder leans into the table
    assert planner._meets(effects, there, down, np.repeat(pose[None], len(way), 0))


@pytest.mark.parametrize(
    ("text", "says"),
    [
        (None, "neither a task of the library nor a file"),
        ("{", "not goals"),
        ('{"goals": []}', "holds no goals"),
        ('{"goals": [{"object": 7, "p_WO": [0, 0, 0]}]}', "from 0 to 3"),
        ('{"goals": [{"object": 0}]}', "p_WO or q_WO"),
        ('{"goals": [{"object": 0, "q_WO": [0, 0, 0, 0]}]}', "not all 0"),
    ],
)
def test_bad_goals_are_one_line(tmp_path, text, says):
    path = tmp_path / "goal.json"
    if text is not None:
        path.write_text(text)
    with pytest.raises(UserError, match=says):
        load_goals(path)


@pytest.mark.parametrize(
    "spoil",
    [
        lambda d: d.pop("skills"),
        lambda d: d["skills"][0].update(z=[0] * 3),
        lambda d: d["skills"][0].update(min_ticks=0),
    ],
)
def test_a_broken_library_is_one_line_in_python_and_in_cpp(made, tmp_path, spoil):
    for f in made[0].iterdir():
        (tmp_path / f.name).write_bytes(f.read_bytes())
    d = json.loads((tmp_path / "skills.json").read_text())
    spoil(d)
    (tmp_path / "skills.json").write_text(json.dumps(d))
    with pytest.raises(UserError, match="not a skill library"):
        Library.load(tmp_path)
    with pytest.raises(RuntimeError, match=r"skills\.json: skill 0: ") as e:
        _core.Rollout(str(paths.MODELS), "pick_place", str(tmp_path))
    assert "\n" not in str(e.value)


def test_a_report_has_figures_pictures_of_failures_and_a_plot(made, tmp_path):
    figures = rollout("pick_place", 2, weights=made[0], perception="truth", report=tmp_path / "r", plan="goal")
    assert figures["success"] == 0, "weights of twelve steps"
    names = sorted(p.name for p in (tmp_path / "r").iterdir())
    assert names == ["displacement.png", "failed_0000.png", "failed_0001.png", "figures.json", "trials.jsonl"]
    assert json.loads((tmp_path / "r" / "figures.json").read_text()) == figures
    assert figures["search_s"]["max"] < 60 and figures["verify_s"]["max"] < 60


def test_displacement_is_that_of_the_farthest_object(library):
    first = next(iter(library.chains.values()))[0].frames[0]
    pose = first.object_pose.copy()
    pose[1, 0] += 1
    assert 90 < displaced_cm(library, "pick_place", Frame(first.q, False, pose, first.known)) < 110


def test_where_practice_cannot_tell_the_best_try_more():
    chains = [*(("a", str(k)) for k in range(3)), *(("b", str(k)) for k in range(3, 7)), ("c", "7"), ("d", "8")]
    won = dict(zip(chains, [3, 2, 1, 4, 4, 3, 4, 0, 4], strict=True))
    assert unsure(won, 4) == [("a", "0"), ("a", "1")]
    # One that always did it may have been lucky.
    won["b", "3"] = won["b", "4"] = 3
    assert unsure(won, 4) == [("a", "0"), ("a", "1"), ("b", "3"), ("b", "4"), ("b", "5"), ("b", "6")]


def test_what_was_done_only_on_being_tried_again_is_worth_less():
    assert [worth({"success": s, "retries": r}) for s, r in ((True, 0), (True, 1), (True, 3), (False, 0))] == [
        1,
        0.5,
        0.25,
        0,
    ]


def test_an_export_with_practice_notes_every_demonstration(made, library, tmp_path):
    export(made[0].parent / "run", tmp_path / "weights", trials=0, practice=1, jobs=2)
    practised = Library.load(tmp_path / "weights")
    assert set(practised.practice) == set(practised.chains) == set(library.chains)
    noted = json.loads((tmp_path / "weights" / "skills.json").read_text())["practice"]
    assert all(0 <= c["success"] <= c["trials"] in (1, 2) for c in noted)


def test_practice_is_noted_in_the_library_and_plans_are_made_by_it(tmp_path):
    weights = tmp_path / "weights"
    shutil.copytree(paths.MODELS / "weights" / "lite6", weights)
    skills = json.loads((weights / "skills.json").read_text())
    two = [("pick_place", "demo_1"), ("drawer_open", "demo_12")]
    skills["skills"] = [s for s in skills["skills"] if (s["task"], s["source"]) in two]
    skills["practice"] = [{"task": t, "source": s, "trials": 1, "success": 0} for t, s in two]
    (weights / "skills.json").write_text(json.dumps(skills))
    shares = []
    practise(weights, 1, 2, lambda share, text: shares.append(share))
    noted = json.loads((weights / "skills.json").read_text())
    assert noted["skills"] == skills["skills"] and max(shares) == 1
    assert [(c["task"], c["source"]) for c in noted["practice"]] == two
    assert all(c["success"] > 0 for c in noted["practice"])
    # To leave one of two out is no gain, whatever practice says of it.
    planner = Planner(weights)
    planner.library.practice = {two[0]: 0.5, two[1]: 1.0}
    pick, drawer = (next(e for e in planner.effects if e.chain[0].task == t) for t, _ in two)
    assert planner.unpractised([drawer]) == 0
    assert planner.unpractised([pick]) == 2 * planner.unpractised([pick, drawer]) > 0
    # Nor is to begin with the arm elsewhere.
    home = drawer.first
    elsewhere = Frame(home.q + [0, 0, 0, 2, 0, 0], False, home.object_pose, home.known)
    assert planner.doubt([drawer, pick], elsewhere) == pytest.approx(
        planner.doubt([drawer, pick], home) + APART * TURN_LENGTH * 2
    )


def test_a_demonstration_whose_hand_misses_in_the_head_is_not_played(monkeypatch):
    planner = Planner(paths.MODELS / "weights" / "lite6")
    session = _core.Session(str(paths.MODELS), "box_open", "")
    session.reset(6_000_001, 10.0)
    seen = seen_from(session.observe())
    nearest = whole(planner.library, "box_open", seen)
    chosen = planner.for_task("box_open", seen)
    chains = as_good(planner.library, "box_open")
    played = planner._play(chains, seen)
    beside = {
        c[0].source: planner._beside(c, q, pose)
        for c, q, pose in zip(chains, played["q"], played["object_pose"], strict=True)
    }
    assert beside[chosen.skills[0].source] < beside[nearest.skills[0].source]
    # So far beside as the object lies elsewhere, but for what is forgiven.
    own = chains[0][0].frames[0]
    there = planner._play([chains[0]], own)
    q, pose = there["q"][0], there["object_pose"][0]
    hits = planner._beside(chains[0], q, pose)
    pose[..., 0] += 0.2
    assert hits < 0.02 and planner._beside(chains[0], q, pose) == pytest.approx(0.2 - FORGIVEN, abs=0.03)
    monkeypatch.setattr(planner, "_beside", lambda *_: 0.0)
    assert planner.for_task("box_open", seen).about == nearest.about


def test_a_run_needs_a_scene(made, library):
    z, ticks, index = whole(library, "pick_place", None).arrays()
    with pytest.raises(RuntimeError, match="reset"):
        _core.Rollout(str(paths.MODELS), "pick_place", str(made[0])).run(z, ticks, index)


@pytest.mark.parametrize(
    ("task", "orders"),
    [("pour+stir", {("pour", "stir")}),
     ("drawer_open+pick_place", {("drawer_open", "pick_place"), ("pick_place", "drawer_open")})],
)  # fmt: skip
def test_what_concerns_one_object_is_done_in_the_order_asked_for(task, orders):
    from intabs.skills.planner import Planner, goals_of, seen_from

    planner = Planner(paths.MODELS / "weights" / "lite6")
    session = _core.Session(str(paths.MODELS), task, "")
    session.reset(3, 2.0)
    seen = seen_from(session.observe())
    found = planner.search(goals_of(planner.library, task, seen), seen)
    pairs = {tuple(e.chain[0].task for e in c.sequence) for c in found if len(c.sequence) == 2}
    assert orders <= pairs and (len(orders) == 2 or ("stir", "pour") not in pairs)


def test_a_composition_is_found_with_at_most_64_plans_in_the_head(monkeypatch):
    planner = Planner(paths.MODELS / "weights" / "lite6")
    session = _core.Session(str(paths.MODELS), "box_open+pour", "")
    session.reset(4, 2.0)
    seen = seen_from(session.observe())
    played, play = [], planner._in_the_head

    def watched(candidates, *rest):
        got = play(candidates, *rest)
        played.append((candidates, got[0]))
        return got

    monkeypatch.setattr(planner, "_in_the_head", watched)
    plan = planner.for_task("box_open+pour", seen)
    assert {s.task for s in plan.skills} == {"box_open", "pour"}
    (first, cost), (more, cost_of_more) = played
    assert len(first) + len(more) <= CANDIDATES
    # Each beginning once; then the best ones, with others that go on from them.
    begins = [id(c.sequence[0]) for c in first]
    assert len(set(begins)) == len(begins) > KEPT
    assert {id(c.sequence[0]) for c in more} <= {begins[k] for k in np.argsort(cost)[:KEPT]}
    every = [*zip(cost, first, strict=True), *zip(cost_of_more, more, strict=True)]
    best = min(every, key=lambda x: x[0])[1]
    assert plan.skills == [s for e in best.sequence for s in e.chain]
