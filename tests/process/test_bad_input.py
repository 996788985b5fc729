"""One clear line, a non-zero exit and no hang for what a user can get wrong."""

import json
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from bench import TASK, WEIGHTS, Bench, ends, need_programs
from intabs import bus, paths
from intabs.processes import shared_memory_name

need_programs()


def one_line(program: str, *args: object) -> str:
    code, lines = ends(program, *args)
    assert code != 0
    assert len(lines) == 1, lines
    assert lines[0].startswith(f"{program}: "), lines[0]
    return lines[0]


def control_with(weights: Path) -> str:
    return one_line("intabs_control", "--lcm", bus.private_url(), "--weights", weights)


@pytest.fixture
def weights(tmp_path) -> Path:
    copy = tmp_path / "weights"
    shutil.copytree(WEIGHTS, copy)
    return copy


def test_missing_weights(tmp_path):
    assert str(tmp_path / "absent") in control_with(tmp_path / "absent")


def test_missing_manifest(weights):
    (weights / "manifest.json").unlink()
    assert "manifest.json" in control_with(weights)


def test_manifest_that_is_not_json(weights):
    (weights / "manifest.json").write_text("{")
    assert "manifest.json" in control_with(weights)


def test_missing_tensors(weights):
    (weights / "weights.safetensors").unlink()
    assert "weights.safetensors" in control_with(weights)


@pytest.mark.parametrize("share", [0.0, 0.001, 0.5, 0.999])
def test_weights_that_are_cut(weights, share):
    path = weights / "weights.safetensors"
    data = path.read_bytes()
    path.write_bytes(data[: int(share * len(data))])
    assert "weights" in control_with(weights)


def test_weights_that_are_not_those_of_the_manifest(weights):
    path = weights / "weights.safetensors"
    data = bytearray(path.read_bytes())
    data[-1] ^= 1
    path.write_bytes(data)
    assert "sha256" in control_with(weights).lower()


@pytest.mark.parametrize("change", ["number", "list", "null", "text"])
def test_manifest_that_does_not_match(weights, change):
    """Whatever single value of the manifest is exchanged for another of a wrong kind or size, loading says so."""
    manifest = json.loads((weights / "manifest.json").read_text())
    value = {"number": 7777, "list": [], "null": None, "text": "nonsense"}[change]
    for key in manifest:
        if key in ("training_data_sha256", "created", "note") or type(manifest[key]) is type(value) is str:
            continue
        (weights / "manifest.json").write_text(json.dumps({**manifest, key: value}))
        code, lines = ends("intabs_control", "--lcm", "udpm://nowhere", "--weights", weights)
        assert code != 0
        assert len(lines) == 1, (key, lines)


def test_unknown_task_of_the_plant():
    line = one_line("intabs_plant", "--lcm", bus.private_url(), "--models", paths.MODELS, "--task", "juggle")
    assert "juggle" in line
    assert TASK in line  # what is known


def test_missing_models_of_the_plant(tmp_path):
    one_line("intabs_plant", "--lcm", bus.private_url(), "--models", tmp_path, "--task", TASK)


@pytest.mark.parametrize("program", ["intabs_plant", "intabs_control", "intabs_perception"])
def test_a_faulty_configuration_names_file_and_key(program, tmp_path):
    file = tmp_path / "c.yaml"
    for text, part in (("nonsense: 1\n", 'key "nonsense"'), ("lcm: {a: 1}\n", 'key "lcm"'), ("lcm: [\n", "line 2")):
        file.write_text(text)
        line = one_line(program, "--config", file)
        assert str(file) in line
        assert part in line


@pytest.mark.parametrize("program", ["intabs_plant", "intabs_control"])
def test_a_faulty_value_of_a_configuration_names_file_and_key(program, tmp_path):
    file = tmp_path / "c.yaml"
    file.write_text("clock: sundial\n")
    line = one_line(program, "--config", file)
    assert str(file) in line
    assert 'key "clock"' in line
    assert str(file) not in one_line(program, "--config", file, "--clock", "moon")


def test_no_camera():
    ring = shared_memory_name()
    config = paths.MODELS / "config" / "perception.yaml"
    line = one_line("intabs_perception", "--lcm", bus.private_url(), "--ring", ring, "--config", config)
    assert ring in line


def test_control_that_wants_poses_when_there_is_no_perception(tmp_path):
    with Bench(tmp_path, clock="lockstep", perception="truth") as bench:
        bench.plant()
        bench.until(lambda: bench.heard["PLANT_TRUTH"], "the plant speaks")
        bench.perception_source = "tags"
        control = bench.control()
        bench.play()
        bench.until(lambda: control.poll() is not None, "control gives up")
        assert control.returncode == 1
        assert "intabs_perception" in bench.processes.last_line("intabs_control")


def test_two_plants_on_one_group(tmp_path):
    with Bench(tmp_path, perception="truth") as bench:
        first = bench.plant()
        bench.until(lambda: bench.heard["LITE6_STATUS"], "the first plant speaks")
        second = bench.plant(name="second plant")
        bench.until(lambda: second.poll() is not None, "the second plant gives way")
        assert second.returncode != 0
        assert "another" in bench.processes.last_line("second plant")
        bench.listen(0.3)
        assert first.poll() is None


def intabs_demo(*args: object, cwd: Path) -> subprocess.CompletedProcess:
    code = "import sys; from intabs.cli import run; sys.exit(run(sys.argv[1:]))"
    command = [sys.executable, "-c", code, "demo", *map(str, args)]
    return subprocess.run(command, capture_output=True, text=True, cwd=cwd, timeout=120)


def test_demo_of_an_unknown_task(tmp_path):
    done = intabs_demo("--task", "juggle", cwd=tmp_path)
    assert done.returncode == 1
    assert done.stderr.splitlines() == [done.stderr.strip()]
    assert done.stderr.startswith("intabs demo: unknown task 'juggle'")
    assert TASK in done.stderr


def test_demo_into_a_folder_that_is_a_file(tmp_path):
    (tmp_path / "out").write_text("")
    done = intabs_demo("--out", tmp_path / "out", cwd=tmp_path)
    assert done.returncode == 1
    assert done.stderr.startswith("intabs demo: ")
    assert "Traceback" not in done.stderr
