"""Fuzz one target: ``python -m tests.fuzz TARGET [--seconds N]``; with files behind it, only run those through it.

The engine is atheris (coverage-guided, libFuzzer) where it is installed, and a plain loop of small changes to the
corpus where it is not. What it finds is written into the corpus, where every later test run meets it.
"""

from __future__ import annotations

import argparse
import os
import subprocess
import sys
import tempfile
import traceback
from contextlib import nullcontext
from hashlib import sha256
from importlib.util import find_spec
from pathlib import Path
from time import monotonic  # noqa: TID251  an engine runs for so long
from typing import Any

INSTRUMENTED = ["autopilot", "gains", "sitl"]
FOLDER_VARIABLE = "LAGPROOF_FUZZ_FOLDER"
"""Environment variable that names the folder of a process in which libFuzzer runs."""
SECONDS_PER_INPUT = 30
MAX_MIB = 2048
FOUND = 77
"""Exit code of a run that has found something, in both engines."""


def main() -> int:
    parser = argparse.ArgumentParser(prog="python -m tests.fuzz", description=__doc__)
    parser.add_argument("target")
    parser.add_argument("files", nargs="*", type=Path, help="inputs to reproduce, one after the other")
    parser.add_argument("--seconds", type=float, default=60.0)
    parser.add_argument("--engine", choices=("atheris", "mutation"), help="by default atheris if there is one")
    options = parser.parse_args()
    engine = options.engine or ("atheris" if find_spec("atheris") else "mutation")
    if engine == "atheris" and not options.files and FOLDER_VARIABLE not in os.environ:
        return _as_child(options.target, options.seconds)
    with _instrumented(engine if not options.files else "none"):
        from tests.fuzz.targets import CORPUS, TARGETS, corpus_of
    if options.target not in TARGETS:
        parser.error(f"expected a target of {', '.join(TARGETS)}, found {options.target}")
    target = TARGETS[options.target]
    for path in options.files:
        target.run(path.read_bytes())
    if options.files:
        return 0
    print(f"{options.target}: {engine} for {options.seconds:g} s", flush=True)
    if engine == "atheris":
        _with_atheris(target, CORPUS / options.target, options.seconds)
    from tests.fuzz.mutation import loop

    deadline = monotonic() + options.seconds
    seed = int.from_bytes(sha256(options.target.encode()).digest()[:4], "little")
    samples = list(corpus_of(options.target).values())
    ran, data, error = loop(target.run, samples, target.words, lambda: monotonic() > deadline, seed)
    print(f"{options.target}: {ran} inputs", flush=True)
    if data is None or error is None:
        return 0
    path = CORPUS / options.target / f"crash-{sha256(data).hexdigest()[:12]}"
    path.write_bytes(data)
    print(f"{path} was written; python -m tests.fuzz {options.target} {path}", file=sys.stderr)
    traceback.print_exception(error)
    return FOUND


def _as_child(target: str, seconds: float) -> int:
    """Run the engine in a process of its own: libFuzzer ends the one that it is in, and leaves its files behind."""
    memory = Path("/dev/shm")
    with tempfile.TemporaryDirectory(prefix="lagproof-fuzz-", dir=memory if memory.is_dir() else None) as folder:
        command = [sys.executable, "-m", "tests.fuzz", target, "--seconds", str(seconds), "--engine", "atheris"]
        return subprocess.run(command, env={**os.environ, FOLDER_VARIABLE: folder}, check=False).returncode


def _instrumented(engine: str) -> Any:
    """Return a context in which imported modules tell the engine which branches they take."""
    if engine != "atheris":
        return nullcontext()
    import atheris

    return atheris.instrument_imports(include=INSTRUMENTED)


def _with_atheris(target: Any, corpus: Path, seconds: float) -> None:
    """Fuzz, and end the process: libFuzzer does. New inputs that only cover more go where nobody keeps them."""
    import atheris

    folder = Path(os.environ[FOLDER_VARIABLE])
    dictionary = folder / "words"
    dictionary.write_text("".join(f'"{_escaped(word)}"\n' for word in target.words))
    fresh = folder / "fresh"
    fresh.mkdir()
    options = {
        "max_total_time": max(1, round(seconds)),
        "timeout": SECONDS_PER_INPUT,
        "rss_limit_mb": MAX_MIB,
        "max_len": 1 << 14,
        "dict": dictionary,
        "artifact_prefix": f"{corpus}/",
        "print_final_stats": 1,
        "verbosity": 0,
    }

    def one_input(data: bytes) -> None:
        target.run(data)

    atheris.Setup(
        ["fuzz", *(f"-{name}={value}" for name, value in options.items()), str(fresh), str(corpus)], target.run
    )
    atheris.Fuzz()


def _escaped(word: bytes) -> str:
    return "".join(f"\\x{byte:02x}" for byte in word)


if __name__ == "__main__":
    sys.exit(main())
