"""Hours of damaged files by hand: `python -m tests.fuzz.campaign --seconds 600`.

Two engines share the table of targets: `mutations` tries damaged copies of a good file, `atheris`
(libFuzzer) keeps those that reach new lines of Python and spoils these further. Each runs in a
process of its own, so that a library's crash is counted and not suffered. Files that led to faults
are kept in the folder given by `--keep`.
"""

import argparse
import contextlib
import faulthandler
import hashlib
import json
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from pathlib import Path
from random import Random
from typing import Any

from tests.fuzz.judge import LONGEST_S
from tests.fuzz.mutations import MOST_BYTES, mutate

_ENGINES = ("mutations", "atheris")
_PACKAGES = ["alice_survey", "camera_calib", "missions", "reconstruct"]
_STUCK_S = LONGEST_S + 5.0
"""After so long in one call, not even an alarm could stop it."""


@dataclass
class Count:
    """What one engine did with one target."""

    executions: int = 0
    seconds: float = 0.0
    slowest_s: float = 0.0
    peak_bytes: int = 0
    faults: dict[str, str] = field(default_factory=dict)
    """By what and where: the file that led to it first."""

    def add(self, other: "Count") -> None:
        """Count what another process did."""
        self.executions += other.executions
        self.seconds += other.seconds
        self.slowest_s = max(self.slowest_s, other.slowest_s)
        self.peak_bytes = max(self.peak_bytes, other.peak_bytes)
        self.faults = {**other.faults, **self.faults}


def main(arguments: Sequence[str] | None = None) -> int:
    """Try targets for some time, and print a table; 1 where there were faults."""
    parser = argparse.ArgumentParser(prog="python -m tests.fuzz.campaign", description=__doc__)
    parser.add_argument("--seconds", type=float, default=600.0, help="of all targets together")
    parser.add_argument("--target", action="append", help="name of one; several times for more")
    parser.add_argument("--group", action="append", help="of targets: areas, logs, ...")
    parser.add_argument("--engine", choices=_ENGINES, help="one of the two")
    parser.add_argument("--jobs", type=int, default=1, help="processes at a time")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--keep", type=Path, default=Path(tempfile.gettempdir()) / "fuzz-faults")
    parser.add_argument("--child", type=Path, help=argparse.SUPPRESS)
    asked = parser.parse_args(arguments)
    engines = [asked.engine] if asked.engine else list(_ENGINES)
    if asked.child is not None:
        _child(asked.target[0], asked.engine, asked.seconds, asked.seed, asked.child, asked.keep)
        return 0
    names = asked.target or _names(asked.group)
    jobs = [(name, engine) for name in names for engine in engines]
    share_s = asked.seconds * asked.jobs / len(jobs)
    asked.keep.mkdir(parents=True, exist_ok=True)
    with ThreadPoolExecutor(asked.jobs) as pool:
        counts = list(pool.map(lambda job: _supervise(*job, share_s, asked.seed, asked.keep), jobs))
    print(_table(jobs, counts))  # noqa: T201
    return int(any(count.faults for count in counts))


def _names(groups: Sequence[str] | None) -> list[str]:
    from tests.fuzz.targets import GROUPS

    return [target.name for group in groups or GROUPS for target in GROUPS[group]]


def _table(jobs: Sequence[tuple[str, str]], counts: Sequence[Count]) -> str:
    rows = [
        "| target | engine | executions | seconds | faults | slowest, s | peak, MiB |",
        "|---|---|---:|---:|---:|---:|---:|",
    ]
    total = Count()
    for (name, engine), count in zip(jobs, counts, strict=True):
        total.add(Count(**{**count.__dict__, "faults": {}}))
        rows.append(_row(name, engine, count, len(count.faults)))
    found = {f"{name}: {what}": file for (name, _), c in zip(jobs, counts, strict=True)
             for what, file in c.faults.items()}  # fmt: skip
    rows.append(_row(f"all {len({name for name, _ in jobs})}", "both", total, len(found)))
    rows += ["", *(f"- {what} ({file})" for what, file in sorted(found.items()))]
    return "\n".join(rows)


def _row(name: str, engine: str, count: Count, faults: int) -> str:
    return (
        f"| {name} | {engine} | {count.executions} | {count.seconds:.0f} | {faults} | "
        f"{count.slowest_s:.2f} | {count.peak_bytes >> 20} |"
    )


def _supervise(name: str, engine: str, seconds: float, seed: int, keep: Path) -> Count:
    """Run children until the time is over; one that died has found a fault, another follows."""
    total = Count()
    ends = time.monotonic() + seconds
    while (left_s := ends - time.monotonic()) > 0 and len(total.faults) < 20:
        with tempfile.TemporaryDirectory() as folder:
            place = Path(folder)
            command = [
                sys.executable, "-m", "tests.fuzz.campaign", "--child", folder, "--target", name,
                "--engine", engine, "--seconds", f"{left_s:.2f}", "--seed", str(seed),
                "--keep", str(keep),
            ]  # fmt: skip
            started = time.monotonic()
            with (place / "log").open("wb") as log:
                ended = subprocess.run(command, stdout=log, stderr=log, check=False)
            count = _counted(place)
            count.seconds = time.monotonic() - started
            if not (place / "ended").exists():
                _add_death(count, place, name, ended.returncode, keep)
            total.add(count)
        seed += 1000
    return total


def _counted(place: Path) -> Count:
    try:
        return Count(**json.loads((place / "count.json").read_text(encoding="utf-8")))
    except FileNotFoundError:
        return Count()


def _add_death(count: Count, place: Path, name: str, code: int, keep: Path) -> None:
    """The child's end as a fault, with the file that it was reading."""
    log = (place / "log").read_text(encoding="utf-8", errors="replace").splitlines()
    if any(line.startswith("Timeout (") for line in log):
        what = f"hangs for over {_STUCK_S:g} s"
    else:
        what = f"dies with {code}"
    frames = [line.strip() for line in log if line.strip().startswith('File "')]
    own = next((f for f in frames if any(f"/{p}/" in f for p in _PACKAGES)), "")
    last = place / "last"
    if not last.exists():
        what, own = f"{what} before the first execution", " ".join(log[-3:])
    kept = _kept(keep, name, last.read_bytes() if last.exists() else b"")
    count.faults[f"{what} {own}".strip()] = kept


def _kept(keep: Path, name: str, data: bytes) -> str:
    plain = "".join(c if c.isalnum() else "_" for c in name)
    path = keep / f"{plain}.{hashlib.blake2b(data, digest_size=4).hexdigest()}"
    path.write_bytes(data)
    return str(path)


def _child(name: str, engine: str, seconds: float, seed: int, place: Path, keep: Path) -> None:
    """Try one target with one engine; ends the process."""
    import warnings

    warnings.simplefilter("ignore")
    imports = contextlib.nullcontext() if engine == "mutations" else _instrumented()
    with imports:
        from tests.fuzz.targets import TARGETS, Trial

        trial = Trial(TARGETS[name], place / "sandbox")
    count, told_at = Count(), [time.monotonic()]

    def attempt(data: bytes) -> None:
        (place / "last").write_bytes(data)
        faulthandler.dump_traceback_later(_STUCK_S, exit=True)
        verdict = trial.verdict(data)
        faulthandler.cancel_dump_traceback_later()
        count.executions += 1
        count.slowest_s = max(count.slowest_s, verdict.took_s)
        count.peak_bytes = max(count.peak_bytes, verdict.peak_bytes)
        if verdict.outcome == "fault" and verdict.told not in count.faults:
            file = _kept(keep, name, data)
            Path(f"{file}.txt").write_text(f"{verdict.told}\n{verdict.trace}", encoding="utf-8")
            count.faults[verdict.told] = file
            tell()
        if time.monotonic() - told_at[0] > 1.0:
            tell()

    def tell() -> None:
        told_at[0] = time.monotonic()
        (place / "count.new").write_text(json.dumps(count.__dict__), encoding="utf-8")
        (place / "count.new").replace(place / "count.json")

    run = _mutations if engine == "mutations" else _atheris
    run(trial, attempt, seconds, seed, place, lambda: (tell(), (place / "ended").touch()))


def _mutations(
    trial: Any, attempt: Callable[[bytes], None], seconds: float, seed: int, _: Path,
    finish: Callable[[], object],
) -> None:  # fmt: skip
    ends, rng = time.monotonic() + seconds, Random(seed)  # noqa: S311
    while time.monotonic() < ends:
        attempt(mutate(trial.good, trial.target.syntax, rng))
    finish()


@contextlib.contextmanager
def _instrumented() -> Iterator[None]:
    """Modules of the project that are imported inside report which of their lines are run."""
    import atheris

    with atheris.instrument_imports(include=_PACKAGES, exclude=_compiled_modules()):
        yield


def _compiled_modules() -> list[str]:
    """Modules with kernels that numba compiles: it takes no instrumented bytecode."""
    root = Path(__file__).resolve().parents[2]
    files = (file for package in _PACKAGES for file in (root / package).rglob("*.py"))
    return [
        ".".join(file.relative_to(root).with_suffix("").parts).removesuffix(".__init__")
        for file in files
        if "njit" in file.read_text(encoding="utf-8")
    ]


def _atheris(
    trial: Any, attempt: Callable[[bytes], None], seconds: float, seed: int, place: Path,
    finish: Callable[[], object],
) -> None:  # fmt: skip
    import atheris

    corpus = place / "corpus"
    corpus.mkdir()
    (corpus / "good").write_bytes(trial.good)
    ends = time.monotonic() + seconds

    def once(data: bytes) -> None:
        if time.monotonic() > ends:
            finish()
            os._exit(0)  # libFuzzer has no other end
        attempt(data)

    def spoil(data: bytes, most: int, number: int) -> bytes:
        rng = Random(number)  # noqa: S311
        if rng.random() < 0.5:
            return mutate(data, trial.target.syntax, rng)[:most]
        return bytes(atheris.Mutate(data, most))

    longest = min(MOST_BYTES, max(4096, 8 * len(trial.good)))
    settings = [f"-seed={seed}", f"-max_len={longest}", "-timeout=0", "-rss_limit_mb=0"]
    os.chdir(place)
    atheris.Setup([sys.argv[0], *settings, "-detect_leaks=0", str(corpus)], once,
                  custom_mutator=spoil)  # fmt: skip
    atheris.Fuzz()


if __name__ == "__main__":
    raise SystemExit(main())
