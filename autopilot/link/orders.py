"""Orders that a supervisor gives a running program over its record stream: faults on demand.

They reach the driver only, never the node: a node that meets a stepped clock or a broken socket must not know why.
One line of JSON each. A program started by hand has no stream, and nobody can give it any.

One order is no fault: MovePeer. A program that starts again has the ports at which it listens by its command line,
but the one from which it calls is any free one. On a real vehicle it would be the same again; here its neighbour is
told, instead of refusing a stranger until the old peer has been silent for long enough.
"""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import TYPE_CHECKING

import orjson

from autopilot.link.clock import NS_PER_S

if TYPE_CHECKING:
    from autopilot.link.udp import UdpDriver

__all__ = ["BreakSends", "DriftClock", "MovePeer", "Order", "StepClock", "decode_order", "encode_order", "obey"]


@dataclass(frozen=True, slots=True)
class StepClock:
    """Move the node's clock by ``by_ns``."""

    by_ns: int


@dataclass(frozen=True, slots=True)
class DriftClock:
    """Let the node's clock run faster than true time by ``drift_ppb`` parts per billion."""

    drift_ppb: int


@dataclass(frozen=True, slots=True)
class BreakSends:
    """Let every send fail for ``for_ns``."""

    for_ns: int


@dataclass(frozen=True, slots=True)
class MovePeer:
    """Take the UDP port ``number`` of the same host for that of the autopilot's end: its socket is a new one."""

    number: int


Order = StepClock | DriftClock | BreakSends | MovePeer

_DAY_NS = 86_400 * NS_PER_S
_ORDERS: dict[str, tuple[type[Order], str, int, int]] = {
    "step_clock": (StepClock, "by_ns", -_DAY_NS, _DAY_NS),
    "drift_clock": (DriftClock, "drift_ppb", -1_000_000, 1_000_000),
    "break_sends": (BreakSends, "for_ns", 0, _DAY_NS),
    "move_peer": (MovePeer, "number", 1, 65_535),
}
"""Each order's class, its one field, and the least and the largest value of that."""

_LISTENING = "autopilot"
"""The port of plant and relay that takes its peer from what it hears."""


def encode_order(order: Order) -> bytes:
    r"""Return an order as one line of JSON, ending in ``\n``."""
    name = next(name for name, (kind, *_) in _ORDERS.items() if type(order) is kind)
    return orjson.dumps({"order": name, **asdict(order)}, option=orjson.OPT_APPEND_NEWLINE)


def decode_order(line: bytes) -> Order:
    """Return the order of one line.

    Raises
    ------
    ValueError
        If it is none.
    """
    content = orjson.loads(line)
    name = content.get("order") if type(content) is dict else None
    if type(name) is not str or name not in _ORDERS:
        raise ValueError("line is no order")
    kind, field, low, high = _ORDERS[name]
    value = content.get(field)
    if content.keys() != {"order", field} or type(value) is not int or not low <= value <= high:
        raise ValueError(f"order {name}: expected {field}, a whole number from {low} to {high}")
    return kind(value)


def obey(order: Order, driver: UdpDriver) -> None:
    """Carry an order out."""
    match order:
        case StepClock(by_ns):
            driver.step_clock(by_ns)
        case DriftClock(drift_ppb):
            driver.drift_clock(drift_ppb)
        case BreakSends(for_ns):
            driver.break_sends(for_ns)
        case MovePeer(number):
            for port in driver.ports:
                if port.name == _LISTENING and port.peer is not None:
                    port.peer = (port.peer[0], number)
