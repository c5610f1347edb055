"""Reconstruction next to stock COLMAP and pyOrthomosaic on the same pictures, in one run.

    .venv/bin/python -m benchmarks.reconstruct --work FOLDER [--demo WORKSPACE]
        [--pyorthomosaic PYTHON] [--limit SECONDS] [--only peers,hierarchical]
        [--pictures 50,100] [--large 400] [--quick] [--json FILE]

`peers`: rendered pictures of the demo (quarter resolution), 50 and 100 by default. Wall and
processor time, peak memory with children, pictures registered, and errors against the truth. Our
model is aligned rigidly; the others know no scale and are aligned with a free one. COLMAP ends at
the sparse model.
Ours runs on a few pictures first, so that its kernels are compiled, as the others' are.
`hierarchical`: to the sparse model of 400 (`--large`) at an eighth of the resolution, next to
COLMAP's hierarchical and global mappers, which match neighbours by navigation.

pyOrthomosaic (MIT licence, PyPI) is in the extra `bench`; `--pyorthomosaic` names the Python of
another environment that has it. What is not there is left out, and said.
"""

import json
import subprocess
import sys
from collections.abc import Iterable, Sequence
from pathlib import Path

from benchmarks.figures import Findings, Parser, hand_over
from benchmarks.measured import Cost, measured, python
from benchmarks.reconstruct_figures import against_peers
from benchmarks.reconstruct_scores import Accuracy, score_ours, score_peer
from benchmarks.reconstruct_surveys import pictures_of, render, subset, survey_toml

PARTS = ("peers", "hierarchical")
NO_PYORTHOMOSAIC = "pyorthomosaic: not installed; give --pyorthomosaic PYTHON"
_LARGE, _LARGE_QUICK = 400, 24
_PEERS = Path(__file__).with_name("reconstruct_peers.py")
_STAGES = {"sparse": ("mapping", "placing"), "dense": ("dense",), "mosaic": ("mosaic",)}
"""Of ours, by what they end in."""
_RUN = """
import sys
from pathlib import Path
from alice_survey.app.cli.session import session
from alice_survey.app.pipeline import run

with session(sys.argv[1:], quiet=True, files=[Path(sys.argv[2])]):
    run(sys.argv[3:], Path(sys.argv[1]), None)
"""


def ours(workspace: Path, ends: Iterable[str] = tuple(_STAGES)) -> dict[str, Cost]:
    """Cost of ours from each end to the next; ends at the first that fails.

    Events, with the computing of each step, are in `logs` of the workspace.
    """
    costs = {}
    for end in ends:
        log = workspace / "logs" / f"{end}.log"
        arguments = [str(workspace), str(log.with_suffix(".jsonl")), *_STAGES[end]]
        costs[end] = measured([*python("-c", _RUN), *arguments], log)
        if not costs[end].ok:
            break
    return costs


def peer(
    name: str, interpreter: str, pictures: Path, out: Path, limit_s: float, *more: Path
) -> Cost:
    """Cost of another program on a folder of pictures."""
    command = [interpreter, str(_PEERS), name, str(pictures), str(out), *map(str, more)]
    return measured(command, out.with_suffix(".log"), limit_s)


def run_peers(
    work: Path, demo: Path, interpreter: str | None, counts: Sequence[int], limit_s: float
) -> Findings:
    """All programs on the same rendered pictures; ours compiled beforehand."""
    findings = Findings()
    ours(subset(demo, work / "compiled", 8))
    for count in counts:
        part = subset(demo, work / f"peers{count}", count)
        folder = work / f"peers{count}_pictures"
        _emptied(folder)
        pictures_of(part, folder)
        costs = ours(part)
        found = score_ours(part) if costs["sparse"].ok else None
        rivals: dict[str, tuple[Cost | None, Accuracy | None]] = {}
        for name, python_of in (("colmap", sys.executable), ("pyorthomosaic", interpreter)):
            if python_of is None:
                findings += Findings(left_out=(f"{count} pictures: {NO_PYORTHOMOSAIC}",))
                rivals[name] = (None, None)
                continue
            out = _emptied(work / f"peers{count}_{name}")
            cost = peer(name, python_of, folder, out, limit_s)
            accuracy = score_peer(out, part / "images" / "truth") if cost.ok else None
            rivals[name] = (cost, accuracy)
        findings += against_peers(count, costs, found, rivals)
    return findings


def run_hierarchical(work: Path, count: int, limit_s: float) -> Findings:
    """Ours next to mappers that are made for many pictures."""
    whole = work / f"rendered_{count}"
    render(whole, survey_toml(count, 8))
    ours(subset(whole, work / "compiled", 8), ["sparse"])
    part = subset(whole, work / f"hierarchical{count}", count)
    pictures = pictures_of(part, _emptied(work / f"hierarchical{count}_pictures"))
    costs = ours(part, ["sparse"])
    found = score_ours(part) if costs["sparse"].ok else None
    rivals: dict[str, tuple[Cost | None, Accuracy | None]] = {}
    for name in ("hierarchical", "global"):
        out = _emptied(work / f"hierarchical{count}_{name}")
        manifest = part / "images" / "manifest.csv"
        cost = peer(name, sys.executable, pictures, out, limit_s, manifest)
        accuracy = score_peer(out, part / "images" / "truth") if cost.ok else None
        if cost.ok:
            facts = json.loads((out / "cameras.json").read_text())
            spent = ", ".join(f"{step} {s:.0f} s" for step, s in facts["cpu_s"].items())
            print(f"  {facts['pairs']} pairs matched; models of {facts['models']} pictures, "
                  f"{facts['reprojection_px']:.3f} px; computing: {spent}", flush=True)  # fmt: skip
        rivals[name] = (cost, accuracy)
    return against_peers(count, costs, found, rivals)


def _emptied(folder: Path) -> Path:
    """A folder that is not there any more."""
    import shutil

    if folder.exists():
        shutil.rmtree(folder)
    return folder


def find_pyorthomosaic(given: str | None) -> str | None:
    """The Python that has pyOrthomosaic, or None."""
    interpreter = given or sys.executable
    found = subprocess.run([interpreter, "-c", "import orthomosaic"], capture_output=True)
    if found.returncode and given:
        raise SystemExit(f"{given} has no pyOrthomosaic: pip install pyOrthomosaic")
    return None if found.returncode else interpreter


def main() -> int:
    """Run the parts that are requested."""
    parser = Parser(__doc__, quick="small surveys, to see that it runs", work="scratch folder")
    parser.add_argument("--demo", type=Path, help="workspace with rendered demo pictures")
    parser.add_argument("--pyorthomosaic", help="a Python that has pyOrthomosaic")
    parser.add_argument("--only", default=",".join(PARTS), help="parts, by commas")
    parser.add_argument(
        "--limit", type=float, default=3600.0, help="seconds that another program may take"
    )
    parser.add_argument("--pictures", default="50,100", help="of `peers`, by commas")
    parser.add_argument("--large", type=int, default=_LARGE, help="of `hierarchical`")
    given, about = parser.begin("pycolmap", "opencv-contrib-python-headless", "numpy")
    parts = given.only.split(",")
    if unknown := set(parts) - set(PARTS):
        raise SystemExit(f"no part {min(unknown)!r}; there are {', '.join(PARTS)}")
    findings = Findings()
    interpreter = find_pyorthomosaic(given.pyorthomosaic)
    work = given.work.resolve()
    if "peers" in parts:
        demo = given.demo
        if demo is None:
            demo = work / "demo"
            render(demo, survey_toml(20 if given.quick else 116, 8 if given.quick else 4))
        counts = [16] if given.quick else [int(n) for n in given.pictures.split(",")]
        findings += run_peers(work, demo.resolve(), interpreter, counts, given.limit)
    if "hierarchical" in parts:
        large = _LARGE_QUICK if given.quick else given.large
        findings += run_hierarchical(work, large, given.limit)
    return hand_over(given, about, findings)


if __name__ == "__main__":
    sys.exit(main())
