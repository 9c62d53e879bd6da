"""The topics of a recording: what each message says, as JSON Schema with units.

The schemas hold for every message under a strict validator, and keep to what Foxglove and Lichtblick
parse: one type per field, ``properties`` in every object. A field that may be null has two types, which
makes these viewers refuse the whole channel where they look for it; such fields therefore stand under
``allOf``, which validators obey and these viewers pass over.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from types import MappingProxyType
from typing import Any

__all__ = ["FRAME_SCHEMA", "SCHEMAS", "is_topic", "schema_of"]

_FRAME_TOPIC = re.compile(r"mavlink/[a-z0-9_-]{1,32}")
_LINK_TOPIC = re.compile(r"link/[a-z0-9_-]{1,32}/(up|down)")


def _field(kind: str, description: str, *, nullable: bool = False, **more: Any) -> dict[str, Any]:
    """Return the schema of one field: its JSON type and what it means, with its unit."""
    return {"type": [kind, "null"] if nullable else kind, "description": description, **more}


def _vector(description: str, *, nullable: bool = False) -> dict[str, Any]:
    """Return the schema of an array of numbers."""
    return _field("array", description, nullable=nullable, items={"type": "number"})


def _schema(
    title: str,
    description: str,
    optional: Mapping[str, dict[str, Any]] = MappingProxyType({}),
    **fields: dict[str, Any],
) -> Mapping[str, Any]:
    """Return a topic's JSON Schema; every field but the optional ones is required, more fields are allowed.

    The optional ones stand under ``patternProperties``: whatever stands under ``properties`` is in each message.
    """
    certain = {name: field for name, field in fields.items() if isinstance(field["type"], str)}
    nullable = {name: field for name, field in fields.items() if name not in certain}
    schema = {
        "$schema": "https://json-schema.org/draft/2020-12/schema",
        "title": title,
        "description": description,
        "type": "object",
        "properties": certain,
        "required": list(fields),
        "additionalProperties": True,
    }
    if optional:
        schema["patternProperties"] = {f"^{name}$": field for name, field in optional.items()}
    if nullable:
        schema["allOf"] = [{"properties": nullable}]
    return MappingProxyType(schema)


def _link_schema(title: str, way: str) -> Mapping[str, Any]:
    """Return the schema of one direction of the link."""
    return _schema(
        title,
        f"One packet on its way {way}, as the relay saw it.",
        sent_ns=_field("integer", "When the packet entered the link, ns, relay's clock."),
        delivered_ns=_field("integer", "When it left the link, ns, relay's clock; null if lost.", nullable=True),
        number=_field("integer", "Number of the packet in the order of entering, from 1; copies share it."),
        size=_field("integer", "Payload, bytes."),
        fate=_field("string", "What the link did with it: delivered, lost, blackout, refused or gated."),
        copy=_field("integer", "0 for the packet itself, 1 and up for duplicates."),
        optional={
            "requested_ns": _field(
                "integer", "Delay that the link's model asked for, ns; null if it was dropped before.", nullable=True
            ),
            "bits": _field(
                "array",
                "Bits that were flipped, by number; 0 is the lowest of the first byte.",
                items={"type": "integer"},
            ),
            "rule": _field("string", "Messages of the rule that applied, instead of the direction's SPEC."),
        },
    )


SCHEMAS: Mapping[str, Mapping[str, Any]] = MappingProxyType(
    {
        "plant/truth": _schema(
            "Plant truth",
            "The aircraft at one sample, as it really was.",
            k=_field("integer", "Sample number."),
            t_ns=_field("integer", "Time of sample k, ns, plant's clock."),
            late_ns=_field("integer", "How late the tick of sample k was served, ns."),
            x=_vector("State at sample k, absolute, in the model's units."),
            u=_vector("Control held over [k, k+1), absolute, in the model's units."),
            j=_field("integer", "Sample the held command was computed from; null before the first.", nullable=True),
            d=_field("integer", "True delay k - j, samples; null before the first command.", nullable=True),
            w=_vector("Disturbance (gust) at sample k, in the model's units."),
            delta=_field("number", "Uncertainty of the plant at sample k, no unit."),
            timeout=_field("boolean", "The servo time-out holds the control at neutral."),
            optional={
                "air": _field(
                    "object",
                    "What else moves, of an aircraft that is more than its model: SI units, rad, throttle 0 to 1.",
                    properties={},
                    additionalProperties={"type": "number"},
                ),
            },
        ),
        "autopilot/command": _schema(
            "Autopilot command",
            "One command of the control law, Eq. (9), and the delay it was computed for.",
            j=_field("integer", "Sample the command was computed from."),
            sample_ns=_field("integer", "Stamp of that sample, ns, plant's clock."),
            epoch=_field("integer", "Counts the plant's restarts; sample numbers compare within one epoch."),
            x=_vector("State of sample j as received, absolute, in the model's units."),
            xr=_vector("Reference state used in this command; null without a reference.", nullable=True),
            r=_vector("Reference input at sample j; null without a reference.", nullable=True),
            u=_vector("Commanded control after saturation, absolute, in the model's units."),
            saturated=_field("boolean", "Some control reached its limit."),
            d=_field("integer", "Forecast delay of this command, samples; null if unknown.", nullable=True),
            d_low=_field("integer", "Least delay the forecast allows, samples; null if unknown.", nullable=True),
            d_high=_field("integer", "Greatest delay the forecast allows, samples; null if unknown.", nullable=True),
            d_probability=_field("number", "Probability of [d_low, d_high], 0 to 1; null if unknown.", nullable=True),
            status=_field("string", "Status of the delay estimate."),
            mode=_field("string", "Mode of the failsafe."),
            flight_mode=_field(
                "string", "Flight mode that the ground has asked for: MANUAL, STABILIZE, AUTO or GUIDED."
            ),
            armed=_field("boolean", "The vehicle is armed; else the elevator stays neutral."),
            gain_set=_field(
                "integer",
                "Index of the schedule's set of gains in force, 0 with plain gains; their number for the conservative.",
            ),
            alpha=_field("string", "Source of the angle of attack: aoa_ssa; vfr_hud, the noisy one; or none."),
        ),
        "autopilot/estimate": _schema(
            "Autopilot estimates",
            "Once a second: what the autopilot knows of the two clocks and of the loop's delay.",
            offset_ns=_field("integer", "Plant's clock minus own clock, ns; null if unknown.", nullable=True),
            offset_bound_ns=_field("integer", "Largest error of the offset, ns; null if unknown.", nullable=True),
            skew_ppb=_field("number", "How much faster the plant's clock runs, ppb; null if unknown.", nullable=True),
            skew_bound_ppb=_field("number", "Largest error of the skew, ppb; null if unknown.", nullable=True),
            clock=_field("string", "Status of the clock estimate."),
            round_trip_ns=_field(
                "integer", "Median TIMESYNC round trip, this second, ns; null if none.", nullable=True
            ),
            d_mean=_field("number", "Mean d that the plant reported this second; null if none.", nullable=True),
            d_max=_field("integer", "Largest d that the plant reported this second; null if none.", nullable=True),
            exact=_field("number", "Share of the latest forecasts that were right; null if none.", nullable=True),
            covered=_field("number", "Share of them whose interval held d; null if none.", nullable=True),
            changes=_field("integer", "How often the link was found to have changed."),
            shift_ns=_field(
                "integer", "By how much longer commands travel than TIMESYNC, ns, as the forecast takes it."
            ),
            unmatched=_field("integer", "TIMESYNC answers to no request of ours."),
            steps=_field("integer", "How often a clock was found to have stepped."),
        ),
        "link/up": _link_schema("Link up", "from the plant to the autopilot"),
        "link/down": _link_schema("Link down", "from the autopilot to the plant"),
        "events": _schema(
            "Events",
            "Something that happened: a change of mode, a failsafe, a fault, a new epoch.",
            kind=_field("string", "What it was: mode, failsafe, fault, epoch, gains, gain_set, counters, and so on."),
            node=_field("string", "Which node it happened in."),
            text=_field("string", "One line for people."),
            data=_field("object", "Details, depending on kind.", properties={}, additionalProperties=True),
        ),
    }
)
"""JSON Schema of each fixed topic; ``schema_of`` also knows ``mavlink/<port>`` and ``link/<name>/up``, ``.../down``."""

FRAME_SCHEMA = _schema(
    "MAVLink datagram",
    "One datagram at a port of a node.",
    t_ns=_field("integer", "When it was sent or received, ns, node's clock."),
    direction=_field("string", "Seen from the node.", enum=["sent", "received"]),
    frame=_field("string", "The datagram's bytes.", contentEncoding="base64"),
)
"""JSON Schema of the topics ``mavlink/<port>``."""


def is_topic(topic: str) -> bool:
    """Return whether a recording knows the topic."""
    return topic in SCHEMAS or _FRAME_TOPIC.fullmatch(topic) is not None or _LINK_TOPIC.fullmatch(topic) is not None


def schema_of(topic: str) -> Mapping[str, Any]:
    """Return the JSON Schema of a topic.

    Raises
    ------
    ValueError
        If the topic is unknown.
    """
    if not is_topic(topic):
        known = f"{', '.join(SCHEMAS)}, link/<name>/up, link/<name>/down and mavlink/<port>"
        raise ValueError(f"unknown topic {topic[:80]!r}; known are {known}")
    if _LINK_TOPIC.fullmatch(topic):
        return SCHEMAS[f"link/{topic.rpartition('/')[2]}"]
    return SCHEMAS.get(topic, FRAME_SCHEMA)
