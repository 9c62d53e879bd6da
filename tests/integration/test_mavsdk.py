"""MAVSDK flies the vehicle: one session of its asyncio interface, as a program on a companion computer would use it."""

from __future__ import annotations

import asyncio
import json
import math
from collections.abc import AsyncIterator, Awaitable
from dataclasses import dataclass, field
from itertools import pairwise
from statistics import fmean
from typing import Any

import pytest
from mavsdk.asyncio import Autopilot, ComponentType, Configuration, Mavsdk, System, Vehicle
from mavsdk.asyncio.plugins.action import ActionAsync
from mavsdk.asyncio.plugins.mavlink_direct import MavlinkDirectAsync
from mavsdk.asyncio.plugins.offboard import OffboardAsync
from mavsdk.asyncio.plugins.param import ParamAsync
from mavsdk.asyncio.plugins.telemetry import TelemetryAsync
from mavsdk.plugins.mavlink_direct import MavlinkMessage
from mavsdk.plugins.offboard import Attitude
from mavsdk.plugins.param import ParamError

from autopilot.ground.parameters import PARAMETERS
from tests.integration.groundtools import near, vehicle
from tests.integration.programs import free_port

pytestmark = pytest.mark.realtime

PATIENCE_S = 20.0
"""Only a test that is about to fail waits so long."""
PARAMETER, VALUE, OUT_OF_RANGE = "STICK_DEG", 7.5, -1.0
RATE_HZ = 10.0
INTERVALS = 20
"""So many that a machine which is busy for a moment does not change their mean by a tenth."""
GUIDED, STABILIZE = 15, 2
OFFBOARD_DEG = 2.0


@dataclass
class Session:
    """What a program has seen through MAVSDK, and how the aircraft flew: α, q, θ of every sample, rad and rad/s."""

    kind: tuple[Autopilot, Vehicle] | None = None
    armable_while_disarmed: bool = False
    armed: list[bool] = field(default_factory=list)
    parameters: dict[str, float] = field(default_factory=dict)
    integers: int = 0
    read_back: float = math.nan
    after_refusal: float = math.nan
    errors: dict[str, str] = field(default_factory=dict)
    default_ms: list[int] = field(default_factory=list)
    asked_ms: list[int] = field(default_factory=list)
    pitches: list[float] = field(default_factory=list)
    attack_angles: list[float] = field(default_factory=list)
    mode_ack: dict[str, Any] = field(default_factory=dict)
    modes: list[int] = field(default_factory=list)
    flown: list[tuple[float, ...]] = field(default_factory=list)


async def seen(stream: AsyncIterator[Any], count: int = 1, until: Any = None) -> list[Any]:
    """Take values from a subscription: so many, or until one that a predicate accepts."""
    values: list[Any] = []

    async def take() -> None:
        async for value in stream:
            values.append(value)
            if until(value) if until else len(values) >= count:
                return

    await asyncio.wait_for(take(), PATIENCE_S)
    await stream.aclose()
    return values


async def refused(doing: Awaitable[Any]) -> str:
    """Return the name of the error that a parameter's request ends with."""
    try:
        await doing
    except ParamError as error:
        return str(error.result.name)
    return "no error"


async def use_parameters(system: System, session: Session) -> None:
    parameters = ParamAsync(system)
    everything = await parameters.get_all_params()
    session.parameters = {each.name: each.value for each in everything.float_params}
    session.integers = len(everything.int_params) + len(everything.custom_params)
    await parameters.set_param_float(PARAMETER, VALUE)
    session.read_back = await parameters.get_param_float(PARAMETER)
    session.errors["range"] = await refused(parameters.set_param_float(PARAMETER, OUT_OF_RANGE))
    session.errors["name"] = await refused(parameters.get_param_float("NO_SUCH_NAME"))
    session.after_refusal = await parameters.get_param_float(PARAMETER)


async def intervals_ms(telemetry: TelemetryAsync) -> list[int]:
    """Return the times between attitudes on the vehicle's clock, however late they come."""
    attitudes = await seen(telemetry.subscribe_attitude_euler(), INTERVALS + 1)
    return [(after.timestamp_us - before.timestamp_us) // 1000 for before, after in pairwise(attitudes)]


async def fly(system: System, session: Session) -> None:
    telemetry, action = TelemetryAsync(system), ActionAsync(system)
    session.armed += await seen(telemetry.subscribe_armed())
    await seen(telemetry.subscribe_health(), until=lambda health: health.is_armable)
    session.armed += await seen(telemetry.subscribe_armed())
    session.armable_while_disarmed = not any(session.armed)
    await action.arm()
    session.armed += await seen(telemetry.subscribe_armed(), until=bool)
    session.default_ms = await intervals_ms(telemetry)
    await telemetry.set_rate_attitude_euler(RATE_HZ)
    await seen(telemetry.subscribe_attitude_euler(), 2)
    session.asked_ms = await intervals_ms(telemetry)
    climbing = await seen(telemetry.subscribe_attitude_euler(), until=lambda euler: euler.pitch_deg > 3.5)
    session.pitches = [math.radians(each.pitch_deg) for each in climbing]


async def guide(system: System, session: Session) -> None:
    """Stream a pitch reference below that of the profile, and wait until it is flown."""
    offboard, telemetry, direct = OffboardAsync(system), TelemetryAsync(system), MavlinkDirectAsync(system)
    await offboard.set_attitude(Attitude(0.0, OFFBOARD_DEG, 0.0, 0.5))
    await offboard.start()
    pitches = await seen(
        telemetry.subscribe_attitude_euler(), until=lambda euler: abs(euler.pitch_deg - OFFBOARD_DEG) < 0.3
    )
    session.pitches += [math.radians(each.pitch_deg) for each in pitches]
    session.modes.append(await custom_mode(direct))


async def custom_mode(direct: MavlinkDirectAsync) -> int:
    (beat,) = await seen(direct.subscribe_message("HEARTBEAT"))
    return int(json.loads(beat.fields_json)["custom_mode"])


async def talk_directly(system: System, session: Session) -> None:
    direct = MavlinkDirectAsync(system)
    for message in await seen(direct.subscribe_message("AOA_SSA"), 10):
        session.attack_angles.append(math.radians(json.loads(message.fields_json)["AOA"]))
    fields = {"target_system": 1, "target_component": 1, "command": 176, "confirmation": 0}
    params = [1, STABILIZE, 0, 0, 0, 0, 0]
    fields |= {f"param{number}": value for number, value in enumerate(params, 1)}
    order = MavlinkMessage("COMMAND_LONG", 245, 190, 1, 1, json.dumps(fields))
    session.mode_ack = json.loads((await direct.send_command(order)).fields_json)
    session.modes.append(await custom_mode(direct))


async def converse(port: int) -> Session:
    session = Session()
    configuration = Configuration.create_with_component_type(ComponentType.GROUND_STATION)
    async with Mavsdk(configuration) as mavsdk:
        await mavsdk.add_any_connection(f"udpin://127.0.0.1:{port}")
        system = await mavsdk.first_autopilot(timeout_s=PATIENCE_S)
        assert system is not None, "MAVSDK finds no autopilot"
        session.kind = (await system.autopilot_type(), await system.vehicle_type())
        await use_parameters(system, session)
        await fly(system, session)
        await guide(system, session)
        await talk_directly(system, session)
    return session


@pytest.fixture(scope="module")
def session(tmp_path_factory: pytest.TempPathFactory) -> Session:
    port = free_port()
    with vehicle(tmp_path_factory.mktemp("mavsdk"), port) as flying:
        session = asyncio.run(converse(port))
        flying.land()
    session.flown = flying.flown
    return session


def test_mavsdk_takes_the_vehicle_for_an_aircraft_with_an_autopilot(session: Session) -> None:
    assert session.kind == (Autopilot.GENERIC, Vehicle.FIXED_WING)


def test_mavsdk_receives_every_parameter_as_a_float(session: Session) -> None:
    assert session.integers == 0
    assert session.parameters.keys() == {parameter.name for parameter in PARAMETERS}
    for parameter in PARAMETERS:
        assert parameter.low <= session.parameters[parameter.name] <= parameter.high


def test_mavsdk_sets_a_parameter_and_reads_it_back(session: Session) -> None:
    assert session.parameters[PARAMETER] != VALUE
    assert session.read_back == VALUE


def test_mavsdk_is_told_why_a_parameter_is_refused(session: Session) -> None:
    assert session.errors == {"range": "VALUE_OUT_OF_RANGE", "name": "DOES_NOT_EXIST"}
    assert session.after_refusal == VALUE


def test_a_vehicle_that_waits_is_armable_and_armed_only_when_mavsdk_asks(session: Session) -> None:
    assert session.armable_while_disarmed
    assert session.armed[0] is False
    assert session.armed[-1] is True


def test_mavsdk_sets_the_rate_of_the_attitude(session: Session) -> None:
    """An attitude that came late does not delay the ones after it, so the mean says the rate; exact in virtual time."""
    assert fmean(session.default_ms) == pytest.approx(50.0, rel=0.1)
    assert fmean(session.asked_ms) == pytest.approx(1000.0 / RATE_HZ, rel=0.1)


def test_mavsdk_sees_the_pitch_that_was_flown(session: Session) -> None:
    flown = [x[2] for x in session.flown]
    assert len(set(session.pitches)) > 10
    assert all(near(pitch, flown) for pitch in session.pitches)


def test_mavlink_direct_decodes_angles_of_attack_that_the_plant_had(session: Session) -> None:
    flown = [x[0] for x in session.flown]
    assert len(set(session.attack_angles)) > 1
    assert all(near(angle, flown) for angle in session.attack_angles)


def test_mavsdks_offboard_mode_guides_the_pitch(session: Session) -> None:
    assert session.modes[0] == GUIDED
    assert math.degrees(session.pitches[-1]) == pytest.approx(OFFBOARD_DEG, abs=0.3)


def test_mavlink_direct_changes_the_mode(session: Session) -> None:
    assert (session.mode_ack["command"], session.mode_ack["result"]) == (176, 0)
    assert session.modes[1] == STABILIZE
