"""A recording as a flight: what was flown, by which law, and what is proved of it, from the one file.

A recording of ``sitl fly`` holds the texts of the files that it was flown with, as MCAP attachments: ``model.toml``,
what was flown; ``gains.toml``, the law with its certificate; ``conservative.toml``, the law's conservative gains; and
``gains-model.toml`` or ``conservative-model.toml`` where a law was designed for another file than ``model.toml``. The
readers of :mod:`gains.store` read them here as they read files, so a certificate whose hashes do not fit is refused.
A recording without them, of an older version, is read with the stored gains of the name that it says; it may be
anybody's, so it never chooses a path.
"""

from __future__ import annotations

import os
import re
import tempfile
import tomllib
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from types import NoneType
from typing import Any

import numpy as np
import orjson
import tomli_w
from mcap.opcode import Opcode
from mcap.records import Attachment, Channel, Metadata
from mcap.records import Message as McapMessage
from mcap.writer import MCAP0_MAGIC

from autopilot.failsafe import Mode
from autopilot.link.record import METADATA_NAME
from gains.gainfile import DELAY_LIMIT
from gains.model import GainLaw, Matrix, Model
from gains.store import load_law, load_model, model_path, parse_law, parse_model, resolve
from gains.table import MAX_FILE_BYTES, InputError, Table, read_content
from sitl.aircraft.plants import is_nonlinear
from sitl.flightdata import FlightData
from sitl.mcapwalk import BAD_CONTENT, MAX_RECORD_BYTES, read_summary, records_in, stream_of, unpack_chunk, walk

__all__ = ["FILES", "MAX_AIR", "MAX_RECORDS", "MAX_SAMPLES", "FlightFile", "attachments_of", "load_flight"]

MODEL, GAINS, CONSERVATIVE = "model.toml", "gains.toml", "conservative.toml"
GAINS_MODEL, CONSERVATIVE_MODEL = "gains-model.toml", "conservative-model.toml"
FILES = (MODEL, GAINS, GAINS_MODEL, CONSERVATIVE, CONSERVATIVE_MODEL)
"""Names of the attachments, in the order in which they are written."""

MAX_ATTACHED_BYTES = MAX_RECORD_BYTES - 4096
"""Longest attachment: ``sitl recover`` must be able to keep it. No longer file is attached."""
MAX_RECORDS = 4_000_000
"""Records of a recording that are looked at, frames aside; further ones are counted."""
MAX_SAMPLES = 20_000_000
"""Longest flight, on the axis of time; a recording that claims a longer one is refused."""
MAX_AIR = 16
"""Further quantities of a sample that are looked at; further ones are passed over."""

_AIR_NAME = re.compile(r"[a-z][a-z0-9_]{0,39}")
_FIELDS: Mapping[str, Mapping[str, type | tuple[type, ...]]] = {
    "plant/truth": {
        "k": int,
        "late_ns": int,
        "x": list,
        "u": list,
        "w": list,
        "j": (int, NoneType),
        "d": (int, NoneType),
        "timeout": bool,
    },
    "autopilot/command": {"j": int, "saturated": bool, "mode": str},
    "link/up": {"sent_ns": int, "delivered_ns": (int, NoneType), "number": int, "copy": int, "fate": str},
    "link/down": {"sent_ns": int, "delivered_ns": (int, NoneType), "number": int, "copy": int, "fate": str},
    "events": {"kind": str, "node": str, "text": str, "data": dict},
}
"""What is read of a record without looking twice."""
_MODES = frozenset(mode.value for mode in Mode)
_STORED_NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9_-]{0,63}")
_MALFORMED = (*BAD_CONTENT, LookupError, TypeError, AttributeError, ArithmeticError)

Kept = tuple[str, int, Mapping[str, Any]]


@dataclass(frozen=True, slots=True, eq=False)
class FlightFile:
    """A recorded flight and what it was flown with.

    Attributes
    ----------
    name : str
        Of the recording: its folder where that is what tells it from others, else the file, without ``.mcap``.
    flight : FlightData
    law : Gains or Schedule
        What flew, with its certificate and conservative gains.
    complete : bool
        Whether the recording itself held law and model; else they are the stored ones of the names in its metadata.
    records : list of (topic, log_time_ns, body)
        All but frames.
    air : mapping of str to ndarray, shape (N,)
        What else the plant told of each sample (airspeed_m_s and so on); nan where it did not. Empty for linear models.
    left_out : int
        Records beyond ``MAX_RECORDS``.
    """

    name: str
    flight: FlightData
    law: GainLaw
    complete: bool
    records: list[Kept]
    air: Mapping[str, Matrix]
    left_out: int

    @property
    def metadata(self) -> Mapping[str, str]:
        """What the recording says about itself."""
        return self.flight.metadata

    @property
    def diverged(self) -> bool:
        """Whether the plant left the range in which it can be flown."""
        return any(event.kind == "diverged" for event in self.flight.events)


# -- writing


def attachments_of(gains_name: str, plant_name: str) -> dict[str, bytes]:
    """Return the texts of the files that a flight is flown with, by the names they have in its recording.

    Parameters
    ----------
    gains_name, plant_name : str
        Stored names or paths; a nonlinear plant is described by the model of the gains.

    Raises
    ------
    InputError
        When one of them cannot be read any more.
    """
    gains_file = resolve(gains_name)
    gains_model = model_path(gains_name)
    files = {MODEL: gains_model if is_nonlinear(plant_name) else resolve(plant_name), GAINS: gains_file}
    files[GAINS_MODEL] = gains_model
    named = Table.load(gains_file).string("conservative", None)
    if named is not None:
        files[CONSERVATIVE] = resolve(named, gains_file.parent)
        files[CONSERVATIVE_MODEL] = model_path(files[CONSERVATIVE])
    texts = {name: read_content(files[name], "a file") for name in FILES if name in files}
    for name in (GAINS_MODEL, CONSERVATIVE_MODEL):
        if texts.get(name) == texts[MODEL]:
            del texts[name]
    return {name: text for name, text in texts.items() if len(text) <= MAX_ATTACHED_BYTES}


# -- reading


def load_flight(path: str | os.PathLike[str]) -> FlightFile:
    """Return the flight of a finished recording.

    Raises
    ------
    InputError
        When the file is no recording, is cut off or damaged (``sitl recover`` makes a finished one of it), holds no
        sample of a plant, or does not tell which law flew.
    """
    path = Path(path)
    read = _read(path)
    texts = {name: text for name, text in read.attachments.items() if name in FILES}
    complete = MODEL in texts and GAINS in texts
    model, law = _attached(path, texts) if complete else _stored(path, read.metadata)
    try:
        for topic, log_time_ns, body in read.records:
            _check(path, topic, body)
            _check_time(path, topic, log_time_ns, body, model)
        flight = FlightData.from_records(read.records, model, read.metadata)
        air = _air(read.records)
    except InputError:
        raise
    except _MALFORMED as error:
        if "plant/truth" in str(error):
            raise InputError(f"{path}: expected samples of a plant (plant/truth), found none") from None
        raise InputError(f"{path}: expected the records of a flight, found malformed ones") from None
    return FlightFile(_name(path), flight, law, complete, read.records, air, read.left_out)


def _name(path: Path) -> str:
    """Return what tells a recording from others: ``sitl fly --out NAME`` calls each ``flight.mcap``."""
    folder = path.absolute().parent.name
    return folder if path.name == "flight.mcap" and folder else path.name.removesuffix(".mcap")


@dataclass(slots=True)
class _Read:
    """What is in a file."""

    metadata: dict[str, str]
    attachments: dict[str, bytes]
    topics: dict[int, str]
    records: list[Kept]
    left_out: int = 0

    def take(self, opcode: int, content: bytes | memoryview) -> None:
        """Take one record of the file."""
        match opcode:
            case Opcode.CHANNEL:
                channel = Channel.read(stream_of(content))
                self.topics[channel.id] = channel.topic
            case Opcode.MESSAGE:
                self._take_message(McapMessage.read(stream_of(content), len(content)))
            case Opcode.METADATA:
                metadata = Metadata.read(stream_of(content))
                if metadata.name == METADATA_NAME and not self.metadata:
                    self.metadata = metadata.metadata
            case Opcode.ATTACHMENT:
                attachment = Attachment.read(stream_of(content))
                if attachment.name in FILES and len(attachment.data) <= MAX_FILE_BYTES:
                    self.attachments.setdefault(attachment.name, attachment.data)

    def _take_message(self, message: McapMessage) -> None:
        topic = self.topics[message.channel_id]
        if topic.startswith("mavlink/"):
            return
        if len(self.records) >= MAX_RECORDS:
            self.left_out += 1
            return
        self.records.append((topic, message.log_time, orjson.loads(message.data)))


def _read(path: Path) -> _Read:
    """Return what is in a finished recording."""
    read = _Read({}, {}, {}, [])
    try:
        with path.open("rb") as file:
            size = file.seek(0, os.SEEK_END)
            file.seek(0)
            if not MCAP0_MAGIC.startswith(file.read(len(MCAP0_MAGIC))) or not size:
                raise InputError(f"{path}: expected a recording (MCAP), found another file")
            summary = read_summary(file, size)
            if summary is None:
                raise InputError(
                    f"{path}: expected a finished recording, found one cut off or damaged;"
                    f" sitl recover {path} makes a finished one of it"
                )
            for opcode, content in _contents(walk(file, len(MCAP0_MAGIC), summary.start)):
                read.take(opcode, content)
    except OSError as error:
        raise InputError(f"{path}: {error.strerror or error}") from None
    except _MALFORMED:
        raise InputError(
            f"{path}: expected whole records, found damaged ones; sitl recover {path} keeps the whole ones"
        ) from None
    return read


def _contents(walked: Iterator[Any]) -> Iterator[tuple[int, bytes | memoryview]]:
    """Yield the records of the data section, those in chunks one by one.

    Raises
    ------
    ValueError
        Where one is torn or its checksum wrong.
    """
    for record in walked:
        if record.opcode == Opcode.DATA_END:
            return
        if record.torn or record.oversize:
            raise ValueError("torn")
        if record.opcode != Opcode.CHUNK:
            yield record.opcode, record.content
            continue
        chunk = unpack_chunk(record)
        if not chunk.whole:
            raise ValueError("damaged chunk")
        yield from records_in(chunk.content)


def _attached(path: Path, texts: Mapping[str, bytes]) -> tuple[Model, GainLaw]:
    """Return model and law of the attached texts, which the usual readers read from a folder of their own."""
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        try:
            for file, text in texts.items():
                if file not in (GAINS, CONSERVATIVE):
                    (folder / file).write_bytes(text)
            model = parse_model(Table.load(folder / MODEL))
            if CONSERVATIVE in texts:
                _write_law(folder, CONSERVATIVE, texts, CONSERVATIVE_MODEL)
            _write_law(folder, GAINS, texts, GAINS_MODEL)
            law = parse_law(Table.load(folder / GAINS))
        except InputError as error:
            raise InputError(f"{path}: attached {str(error).replace(f'{folder}{os.sep}', '')}") from None
    return model, replace(law, conservative_file=None)


def _write_law(folder: Path, file: str, texts: Mapping[str, bytes], model: str) -> None:
    """Write an attached gain file with the names that the attachments have in the place of those it was read by."""
    try:
        content = tomllib.loads(texts[file].decode("utf-8-sig"))
    except (ValueError, RecursionError) as error:
        raise InputError(f"{file}: expected TOML, found: {error}") from None
    content["model"] = str(folder / (model if model in texts else MODEL))
    if "conservative" in content:
        content["conservative"] = str(folder / CONSERVATIVE)
    (folder / file).write_bytes(tomli_w.dumps(content).encode())


def _stored(path: Path, metadata: Mapping[str, str]) -> tuple[Model, GainLaw]:
    """Return the stored model and law of the names that an older recording says."""
    gains, plant = metadata.get("gains", ""), metadata.get("plant", "")
    try:
        if not _STORED_NAME.fullmatch(gains):
            raise InputError("no stored name")
        law = load_law(gains)
        if is_nonlinear(plant) or plant == law.model.name:
            return law.model, law
        if not _STORED_NAME.fullmatch(plant):
            raise InputError("no stored name")
        return load_model(plant), law
    except InputError:
        told = f"gains {Path(gains).name!r} on {Path(plant).name!r}" if gains else "no gains"
        raise InputError(
            f"{path}: expected a recording that holds its model and gains, or names stored ones; found {told}"
        ) from None


def _check(path: Path, topic: str, body: Mapping[str, Any]) -> None:
    """Refuse a record of which some field is of another type than ours are."""
    for name, type_ in _FIELDS.get(topic, {}).items():
        if not isinstance(body[name], type_):
            raise InputError(f"{path}: {topic}: expected another type of {name}, found {type(body[name]).__name__}")
    if topic == "events" and body["kind"] == "failsafe" and not {body["data"]["from"], body["data"]["to"]} <= _MODES:
        raise InputError(f"{path}: events: expected modes of the failsafe, found others")
    if topic == "autopilot/command" and body["mode"] not in _MODES:
        raise InputError(f"{path}: {topic}: expected a mode of the failsafe, found another")


def _check_time(path: Path, topic: str, log_time_ns: int, body: Mapping[str, Any], model: Model) -> None:
    """Refuse times, sample numbers and forecasts that would make an endless axis."""
    if topic == "plant/truth":
        if not 0 <= body["k"] < MAX_SAMPLES or log_time_ns > MAX_SAMPLES * model.Ts_ns:
            raise InputError(f"{path}: expected at most {MAX_SAMPLES} samples, found one beyond")
    elif topic == "autopilot/command":
        for d in (body["d"], body["d_low"], body["d_high"]):
            if d is not None and not 0 <= d <= DELAY_LIMIT:
                raise InputError(f"{path}: expected forecasts of at most {DELAY_LIMIT} samples, found one beyond")


def _air(records: list[Kept]) -> dict[str, Matrix]:
    """Return what else the samples tell, one number per sample each."""
    told = [body.get("air") or {} for topic, _, body in records if topic == "plant/truth"]
    names = [name for name in dict.fromkeys(name for air in told for name in air) if _AIR_NAME.fullmatch(name)][
        :MAX_AIR
    ]
    return {name: np.array([air.get(name, np.nan) for air in told], dtype=np.float64) for name in names}
