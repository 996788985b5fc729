"""What must not stand in any file of the tree, and what must."""

import re
import subprocess

import pytest

from intabs import paths

# Written so that this file does not find itself.
HOSTS = [
    h.replace("_", ".")
    for h in (
        "pypi_org", "pythonhosted_org", "download_pytorch_org", "deb_debian_org", "archive_ubuntu_com", "crates_io",
        "registry_npmjs_org", "conda_anaconda_org", "docker_io", "ghcr_io", "proxy_golang_org", "huggingface_co",
    )
]  # fmt: skip
DEVELOPER_PATHS = re.compile(r"(?<![\w.~])/(?:home|Users|work|root|workspace)/[A-Za-z0-9_]")


def tree() -> list[str]:
    """Files that belong to the source tree: known to git, or about to be."""
    try:
        said = subprocess.run(
            ["git", "-c", "safe.directory=*", "ls-files", "-z", "--cached", "--others", "--exclude-standard"],
            cwd=paths.ROOT,
            capture_output=True,
            check=True,
        ).stdout
    except (OSError, subprocess.CalledProcessError):
        pytest.skip("this tree is no git checkout: its files cannot be told from what was built in it")
    return [n for n in said.decode().split("\0") if n and (paths.ROOT / n).is_file()]


def faults(text: str) -> list[str]:
    found = [h for h in HOSTS if h in text]
    if match := DEVELOPER_PATHS.search(text):
        found.append(match.group())
    return found


def test_no_file_names_a_registry_or_a_developers_machine():
    found = []
    for name in tree():
        data = (paths.ROOT / name).read_bytes()
        if b"\0" in data[:4096]:
            continue
        found += [f"{name}: {what}" for what in faults(data.decode(errors="replace"))]
    assert not found, "\n" + "\n".join(found)


def test_a_host_and_a_path_are_found():
    assert faults("pip install --index-url https://" + "pypi" + ".org/simple x")
    assert faults("/ho" + "me/someone/intabs")
    assert faults("see models/work/x and build/home/y, a/root/b") == []


def test_top_folders_and_front_door_are_there():
    for name in (
        "README.md",
        "LICENSE",
        "CMakeLists.txt",
        "CMakePresets.json",
        ".clang-format",
        ".clang-tidy",
        ".ci/run",
    ):
        assert (paths.ROOT / name).is_file(), name
    for folder in ("cpp", "python", "tests", "tools", "proto_lcm", "models"):
        assert (paths.ROOT / folder / "README.md").is_file(), f"{folder}/README.md"
    assert "Apache License" in (paths.ROOT / "LICENSE").read_text()
