"""The fuzzers at length, one after the other: 10^7 executions each, YAML and manifests 10^6.

    nice -n 10 python tests/cpp/fuzz/run.py BUILD [TARGET ...] [--runs N] [--out DIR]

BUILD is a build folder with the targets fuzz_*_build. A run that finds something ends; its input stays in DIR. Inputs
that reached something new stay in DIR/TARGET for the next run.
"""

import argparse
import os
import re
import subprocess
import sys
from pathlib import Path

HERE = Path(__file__).resolve().parent
MESSAGES = sorted(p.name for p in (HERE / "corpus" / "message").iterdir())
TARGETS = ["report", "reply", "weights", "manifest", "yaml", *MESSAGES]
SLOW = {"manifest": 10**6, "yaml": 10**6}
LONGEST = {"report": 1200, "reply": 1024, "message": 1410}  # bytes; beyond it everything is refused alike


def run(build: Path, target: str, runs: int, out: Path) -> bool:
    program = "message" if target in MESSAGES else target
    corpus = {"message": HERE / "corpus" / "message" / target, "weights": HERE.parent / "nn" / "fuzz_corpus"}
    found = out / target
    found.mkdir(parents=True, exist_ok=True)
    log = out / f"{target}.log"
    with log.open("w") as stream:
        code = subprocess.run(
            [
                *(build / "tests" / "fuzz" / f"{program}_fuzz", f"-runs={runs}"),
                *(f"-max_len={LONGEST.get(program, 4600)}", "-timeout=20"),
                *("-rss_limit_mb=4096", "-print_final_stats=1", f"-artifact_prefix={out}/{target}-"),
                *(found, corpus.get(program, HERE / "corpus" / program)),
            ],
            env={"ASAN_OPTIONS": "quarantine_size_mb=8", **os.environ, "INTABS_MESSAGE": target},
            stdin=subprocess.DEVNULL,
            stdout=stream,
            stderr=stream,
        ).returncode
    text = log.read_text(errors="replace")
    done = re.search(r"number_of_executed_units: *(\d+)", text)
    coverage = re.findall(r" cov: (\d+)", text)
    verdict = "nothing found" if code == 0 else f"FOUND SOMETHING (exit code {code}), see {log}"
    print(
        f"{target}: {done[1] if done else '?'} executions, {coverage[-1] if coverage else '?'} edges, {verdict}",
        flush=True,
    )
    return code == 0


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("build", type=Path)
    parser.add_argument("targets", nargs="*", metavar="TARGET", help=f"of {', '.join(TARGETS)}; default: all")
    parser.add_argument("--runs", type=int, help="instead of 10^7 and 10^6")
    parser.add_argument("--out", type=Path, default=Path("out/fuzz"), help="logs, inputs found, grown corpora")
    a = parser.parse_args()
    if unknown := set(a.targets) - set(TARGETS):
        parser.error(f"unknown target {', '.join(sorted(unknown))}")
    out = a.out.resolve()
    return 0 if all([run(a.build.resolve(), t, a.runs or SLOW.get(t, 10**7), out) for t in a.targets or TARGETS]) else 1


if __name__ == "__main__":
    sys.exit(main())
