"""What the bytes of a file do to whoever loads it: a value that flies, or one line of complaint."""

from __future__ import annotations

import atexit
import os
import shutil
import tempfile
import tomllib
from collections.abc import Mapping
from functools import cache
from itertools import pairwise
from pathlib import Path
from typing import Any
from unittest import mock

import numpy as np
import tomli_w
from mcap.reader import make_reader

from autopilot.app import AutopilotNode
from autopilot.config import AutopilotConfig
from autopilot.ground.parameterfile import ParameterFile
from autopilot.link.keyfile import TimestampStore, read_key, timestamps_path
from autopilot.link.signing import MAX_STREAMS, Signing
from autopilot.profile import parse_profile
from gains import verify_stability
from gains.certificate import claim_hash, law_hash, model_hash
from gains.gainfile import content_of
from gains.store import parse_law, parse_model
from gains.table import InputError, Table
from gains.verify import verified
from gains.witnessfile import read_witness, write_witness
from sitl.arguments import autopilot_arguments, plant_arguments, relay_arguments
from sitl.flightfile import load_flight
from sitl.link.tracefiles import MAX_DELAY_NS, load_table, load_trace
from sitl.rescue import recover
from sitl.scenario import load_scenario
from tests.fuzz.refusing import refusing
from tests.fuzz.texts import TS, check_source
from tests.helpers import HIRM

KEY = bytes(32)
MAX_PRODUCTS = 2_000
"""Products of a tree here: the real limit is seconds of work, and another million of products finds no defect."""


@cache
def _folder() -> Path:
    """Return this process's own folder: in memory where the system has one, and gone when the process has ended."""
    given = os.environ.get("LAGPROOF_FUZZ_FOLDER")
    if given is not None:
        return Path(given)
    memory = Path("/dev/shm")
    folder = Path(tempfile.mkdtemp(prefix="lagproof-fuzz-", dir=memory if memory.is_dir() else None))
    atexit.register(shutil.rmtree, folder, ignore_errors=True)
    return folder


def written(data: bytes, name: str = "input", mode: int = 0o600) -> Path:
    """Return a file that holds the bytes."""
    path = _folder() / name
    path.write_bytes(data)
    path.chmod(mode)
    return path


@refusing(InputError)
def model(data: bytes) -> None:
    """A model file: what is taken is finite, and is the same model from its own numbers."""
    made = parse_model(Table.parse(data, "input.toml"))
    assert all(np.isfinite(part).all() for part in (made.A, made.B, made.E, made.C, made.D))
    assert len(model_hash(made)) == 64


@refusing(InputError)
def law(data: bytes) -> None:
    """A gain file, schedule or not: written again it is the same law; its certificate is verified or is not."""
    made = parse_law(Table.parse(data, "input.toml"))
    again = parse_law(Table.parse(tomli_w.dumps(content_of(made, _model_of(data), None)).encode(), "again.toml"))
    assert law_hash(again) == law_hash(made)
    assert again.certificate == made.certificate
    verified(made)


@refusing(InputError)
def certificate(data: bytes) -> None:
    """A gain file whose hashes are made right, so that what the certificate says is looked at: it ends, passed or not.

    A passed verification speaks of the window that is flown.
    """
    content = _toml(data)
    claim = content.get("certificate")
    if not isinstance(claim, dict):
        raise InputError("there is no certificate to look at")
    bare = parse_law(Table({k: v for k, v in content.items() if k != "certificate"}, "input.toml"))
    hashes = {"model": model_hash(bare.model), "gains": law_hash(bare), "certificate": claim_hash(claim)}
    made = parse_law(Table({**content, "certificate": {**claim, "sha256": hashes}}, "input.toml"))
    with mock.patch.object(verify_stability, "MAX_PRODUCTS", MAX_PRODUCTS):
        verification = verified(made)
    assert not verification.passed or claim["d_min"] <= made.d_min <= made.d_max <= claim["d_max"]


@refusing(InputError)
def witness(data: bytes) -> None:
    """A delay sequence."""
    path = written(data, "witness.csv")
    made = read_witness(path)
    write_witness(path, made)
    assert read_witness(path) == made


@refusing(InputError)
def scenario(data: bytes) -> None:
    """A scenario: what is taken can be built, for either driver."""
    path = written(data, "scenario.toml")
    made = load_scenario(str(path))
    assert made.samples >= 1
    arguments = [*plant_arguments(made), *relay_arguments(made), *autopilot_arguments(made)]
    assert all(isinstance(each, str) for each in arguments)
    made.plant_node()
    made.relay_node()
    made.autopilot_node(1)


@refusing(InputError)
def parameters(data: bytes) -> None:
    """A file of parameters: the vehicle has all its values in range, and keeps them from one start to the next."""
    path = written(data, "parameters.toml")
    kept = _vehicle(path).settings
    values = dict(kept.parameters.values)
    for name, value in values.items():
        each = kept.parameters.table[name]
        assert each.low <= value <= each.high, (name, value)
    assert kept.save() is None
    assert dict(_vehicle(path).settings.parameters.values) == values


def _vehicle(path: Path) -> AutopilotNode:
    return AutopilotNode(AutopilotConfig(HIRM, parameters=ParameterFile(path)))


@refusing(InputError)
def key(data: bytes) -> None:
    """A key file; a complaint says nothing of its content."""
    path = written(data, "key")
    try:
        assert len(read_key(path)) == 32
    except InputError as error:
        secret = data.decode("utf-8", "ignore").strip()
        told = str(error).replace(str(path), "")
        assert len(secret) < 8 or secret not in told
        raise


@refusing(InputError)
def timestamps(data: bytes) -> None:
    """A file of timestamps: what is loaded can be attached, used and stored, and is there the next time."""
    key_file = _folder() / "key"
    path = timestamps_path(key_file, "fuzz")
    path.write_bytes(data)
    path.chmod(0o600)
    store = TimestampStore(key_file, "fuzz", KEY)
    known = store.load("plant")
    assert len(known.floors) <= MAX_STREAMS
    signing = Signing(KEY, 0, 0, known)
    store.attach("plant", signing)
    store.close()
    assert TimestampStore(key_file, "fuzz", KEY).load("plant") == signing.exact()


@refusing(InputError)
def profile_file(data: bytes) -> None:
    """A reference as CSV."""
    path = written(data, "profile.csv")
    check_source(parse_profile(f"file:{path}", TS))


@refusing(InputError)
def trace(data: bytes) -> None:
    """A recorded link, of whichever kind: what a direction or none makes of it is in range at any time and number."""
    path, refusals = written(data, "trace"), []
    for way in ("", "#up", "#down"):
        try:
            loaded = load_trace(f"{path}{way}")
        except InputError as error:
            refusals.append(error)
            continue
        for number, link_ns in ((0, 0), (1, 1), (10**6, 10**9), (2**31, 2**62)):
            delay_ns = loaded.delay_ns(number, link_ns)
            assert delay_ns is None or 0 <= delay_ns <= MAX_DELAY_NS
        times_ns = loaded.times_ns or (0,)
        assert all(sooner <= later for sooner, later in pairwise(times_ns))
    if len(refusals) == 3:
        raise refusals[0]


@refusing(InputError)
def table(data: bytes) -> None:
    """A table of delays."""
    delays_ns = load_table(str(written(data, "table")))
    assert len(delays_ns) >= 2
    assert list(delays_ns) == sorted(delays_ns)
    assert 0 <= delays_ns[0] <= delays_ns[-1] <= MAX_DELAY_NS


@refusing(InputError)
def recovery(data: bytes) -> None:
    """A recording, cut off or damaged: the standard reader finds in the new file what was told, and it is whole."""
    source, target = written(data, "torn.mcap"), _folder() / "rescued.mcap"
    target.unlink(missing_ok=True)
    rescue = recover(source, target)
    assert rescue.bytes_read == len(data)
    assert 0 <= rescue.bytes_dropped <= len(data)
    assert target.exists() != rescue.nothing
    if rescue.nothing:
        raise InputError("there is nothing in it")
    if rescue.complete:
        assert target.read_bytes() == data
        return
    with target.open("rb") as file:
        times_ns = [message.log_time for _, _, message in make_reader(file).iter_messages(log_time_order=False)]
    assert len(times_ns) == rescue.messages
    assert (min(times_ns, default=0), max(times_ns, default=0)) == (rescue.start_ns, rescue.end_ns)
    again = recover(target, _folder() / "again.mcap", force=True)
    assert again.complete, again
    assert again.messages == rescue.messages


@refusing(InputError)
def flight(data: bytes) -> None:
    """A finished recording: a flight with finite times and as many samples as it says, or one line of refusal."""
    found = load_flight(written(data, "flight.mcap"))
    assert len(found.flight.time_s) == len(found.flight.k) > 0
    assert np.isfinite(found.flight.time_s).all()
    assert found.law.model.states == found.flight.model.states


def _toml(data: bytes) -> dict[str, Any]:
    try:
        return tomllib.loads(data.decode())
    except (ValueError, RecursionError):
        raise InputError("no TOML") from None


def _model_of(data: bytes) -> str:
    """Return what a gain file that has been taken calls its model."""
    content: Mapping[str, Any] = tomllib.loads(data.decode("utf-8-sig"))
    return str(content["model"])
