"""Links by name: four made up for tests, and seven after published measurements.

A test holds each measured preset to the ranges that its sources state (``claims``). What they leave open, such as how
often a modem changes its cell, is chosen here, and ``chosen`` says so. Each is one place at one time; for a particular
site record a trace (:mod:`sitl.link.tracefiles`).

*Up* is from the aircraft, *down* to it. The aircraft has the modem, so up is the modem's uplink.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from types import MappingProxyType
from typing import Literal, NamedTuple

from gains.table import InputError
from sitl.link.impairment import LinkSpec
from sitl.link.spec import format_spec, parse_spec

__all__ = ["CATALOGUE", "PRESETS", "SOURCES", "Claim", "Preset", "PresetRow", "Quantity", "parse_link", "preset_table"]

SOURCES: Mapping[str, str] = MappingProxyType(
    {
        "Sui 2016": "K. Sui, M. Zhou, D. Liu, M. Ma, D. Pei, Y. Zhao, Z. Li, T. Moscibroda, Characterizing and "
        "improving WiFi latency in large-scale operational networks, MobiSys 2016",
        "Huang 2012": "J. Huang, F. Qian, A. Gerber, Z. M. Mao, S. Sen, O. Spatscheck, A close examination of "
        "performance and power characteristics of 4G LTE networks, MobiSys 2012",
        "Brand 2014": "M. Brand, J. Pomy, One-way delays in operating LTE networks, ITU workshop on monitoring and "
        "benchmarking of QoS and QoE of multimedia services in mobile networks, Buenos Aires 2014",
        "Xu 2020": "D. Xu et al., Understanding operational 5G: a first measurement study on its coverage, "
        "performance and energy consumption, SIGCOMM 2020",
        "Kottkamp 2022": "M. Kottkamp, 5G NR and LTE latency analysis in a public network, Rohde & Schwarz 2022",
        "Mohamed 2025": "M. A. M. Mohamed, Y. Oniz, Real-time long-range control of an autonomous UAV using 4G LTE "
        "network, Drones 9(12), 812, 2025",
        "Vienna 2023": "Verification of standardized Rel-15 requirements for drone's command-and-control link "
        "reliability, 2023: field trials in Vienna against 3GPP TR 36.777",
        "Baltaci 2022": "A. Baltaci, H. Cech, N. Mohan, F. Geyer, V. Bajpai, J. Ott, D. Schupke, Analyzing real-time "
        "video delivery over cellular networks for remote piloting aerial vehicles, IMC 2022",
        "Gharib 2021": "M. Gharib, S. Nandadapu, F. Afghah, An exhaustive study of using commercial LTE network for "
        "UAV communication in rural areas, arXiv 2105.03778, 2021",
        "Michel 2022": "F. Michel, M. Trevisan, D. Giordano, O. Bonaventure, A first look at Starlink performance, "
        "IMC 2022; figures as in Fact checking Starlink's performance figures, APNIC blog, 28 November 2022, Fig. 1",
        "Huston 2024": "G. Huston, A transport protocol's view of Starlink, APNIC blog, 17 May 2024",
        "Garcia 2025": "J. Garcia, S. Sundberg, A. Brunstrom, A detailed characterization of Starlink one-way delay, "
        "3rd workshop on LEO networking and communication, 2025",
        "Huston 2022": "G. Huston, Testing LEO and GEO satellite services in Australia, APNIC blog, 2 May 2022",
        "Merlach 2026": "G. Merlach, M. Trevisan, Internet usage and performance in GEO satellite networks: a "
        "large-scale study across Europe and Africa, 2026, abstract",
        "SiK": "Firmware of the SiK telemetry radio, github.com/ArduPilot/SiK: tdm_init in Firmware/radio/tdm.c, and "
        "serial.c",
    }
)
"""The sources by the names that claims and choices give them in brackets."""

Quantity = Literal[
    "rtt_min_ms",
    "rtt_mean_ms",
    "rtt_p50_ms",
    "rtt_p90_ms",
    "rtt_p99_ms",
    "rtt_spike_ms",
    "rtt_step_ms",
    "up_above_down_ms",
    "up_within_50ms",
    "rtt_loss",
]
"""What is measured: quantiles of the round trip; how far its 99.9 % quantile is above its median (spike); the mean
difference from one round trip to the next (step); by how much the median way up is longer than the median way down; the
share of packets that are up within 50 ms; the share of round trips that are lost."""


class Claim(NamedTuple):
    """What a source says of a link, as a range for a stream of 40 packets of 100 bytes per second."""

    quantity: Quantity
    low: float
    high: float
    source: str


@dataclass(frozen=True, slots=True)
class Preset:
    """A link by name.

    Attributes
    ----------
    up, down : LinkSpec
        The two directions.
    title : str
        What it is.
    claims : tuple of Claim
        What is known of it, and from where.
    chosen : str
        What was chosen here, and what is simpler than the real link.
    """

    up: LinkSpec
    down: LinkSpec
    title: str
    claims: tuple[Claim, ...] = ()
    chosen: str = "all of it"

    @property
    def source(self) -> str:
        """What the sources say, in one line, with their names of :data:`SOURCES` in brackets."""
        return "; ".join(dict.fromkeys(claim.source for claim in self.claims)) or "chosen here"


def _both(spec: str, title: str, claims: tuple[Claim, ...] = (), chosen: str = "all of it") -> Preset:
    """Return a preset with the same in both directions."""
    return Preset(parse_spec(spec), parse_spec(spec), title, claims, chosen)


_WIFI = _both(
    "delay=0.5ms,jitter=pareto:1.2ms:3.0,loss=0.001,order=keep,handover=20s:350ms,fade=1s:90ms:16ms",
    "WiFi of a busy campus, one hop to the access point",
    (
        Claim("rtt_p50_ms", 2.5, 3.5, "[Sui 2016] Section 1: median 3 ms"),
        Claim("rtt_p90_ms", 16.0, 24.0, "[Sui 2016] abstract: 90 % around 20 ms"),
        Claim("rtt_p99_ms", 200.0, 300.0, "[Sui 2016] abstract: 99 % around 250 ms"),
    ),
    "loss; that the tail is made of busy times of the channel (fade) and of pauses of the radio (handover)",
)

_LTE = Preset(
    parse_spec("delay=20ms,jitter=gamma:12ms,corr=0.3,loss=0.001,order=keep,handover=60s:30ms"),
    parse_spec("delay=14ms,jitter=gamma:5ms,corr=0.3,loss=0.001,order=keep,handover=60s:30ms"),
    "LTE in a city, on the ground",
    (
        Claim("rtt_p50_ms", 30.0, 75.0, "[Brand 2014] 16 + 14 ms of radio at least; [Huang 2012] median around 70 ms"),
        Claim("up_above_down_ms", 2.0, 30.0, "[Brand 2014] up waits for a grant, 10 to 30 ms by the scheduler"),
    ),
    "how often cells change; their length, around 30 ms, is of [Xu 2020]; loss, which retransmissions leave small",
)

_LTE_DRONE = Preset(
    parse_spec(
        "delay=22ms,jitter=gamma:14ms,corr=0.5,loss=ge:0.001:0.2,order=keep,handover=10s:80ms,fade=20s:500ms:60ms:0.05"
    ),
    parse_spec("delay=16ms,jitter=gamma:8ms,corr=0.5,loss=0.002,order=keep,handover=10s:80ms"),
    "LTE at altitude, which sees many cells",
    (
        Claim("up_within_50ms", 0.5, 0.999, "[Vienna 2023] 99.9 % within 50 ms are not reached at up to 120 m"),
        Claim("rtt_mean_ms", 30.0, 150.0, "[Mohamed 2025] mean below 150 ms in flight"),
    ),
    "handovers: more frequent than on the ground [Baltaci 2022], if not everywhere [Gharib 2021]; fading; loss",
)

_5G = Preset(
    parse_spec("delay=9ms,jitter=gamma:4ms,loss=0.001,order=keep,handover=60s:110ms"),
    parse_spec("delay=6ms,jitter=gamma:2ms,loss=0.001,order=keep,handover=60s:110ms"),
    "5G beside LTE (non-standalone), on the ground",
    (
        Claim("rtt_p50_ms", 14.0, 36.0, "[Kottkamp 2022] one way 7 ms (down, at best) to 18 ms (up, at worst)"),
        Claim("up_above_down_ms", 0.0, 11.0, "[Kottkamp 2022] the same"),
    ),
    "how often cells change; their length, around 110 ms, is of [Xu 2020]; loss",
)

_LEO = Preset(
    parse_spec("delay=19ms,jitter=gamma:8ms,corr=0.2,loss=ge:0.003:0.4,order=keep,hold=12s:40ms:15s,fade=15s:15s:5ms"),
    parse_spec("delay=15ms,jitter=gamma:5ms,corr=0.2,loss=ge:0.003:0.4,order=keep,hold=12s:20ms:15s"),
    "Starlink: another satellite or beam each 15 s",
    (
        Claim("rtt_p50_ms", 40.0, 60.0, "[Michel 2022] median around 50 ms, quartiles 40 and 60 ms"),
        Claim("rtt_spike_ms", 30.0, 50.0, "[Huston 2024] each 15 s, 30 to 50 ms on top"),
        Claim("rtt_step_ms", 5.5, 8.0, "[Huston 2024] 6.7 ms from one round trip to the next"),
        Claim("rtt_loss", 0.01, 0.02, "[Huston 2024] 1 to 2 %, whatever the load"),
    ),
    "two levels of delay instead of another one each 15 s (fade); that up waits longer than down is of [Garcia 2025]",
)

_GEO = Preset(
    parse_spec("delay=290ms,jitter=gamma:25ms,corr=0.5,loss=0.002,order=keep"),
    parse_spec("delay=280ms,jitter=gamma:6ms,corr=0.5,loss=0.002,order=keep"),
    "geostationary satellite",
    (
        Claim("rtt_min_ms", 550.0, 600.0, "[Merlach 2026] at least 550 ms"),
        Claim("rtt_p50_ms", 570.0, 640.0, "[Huston 2022] around 600 ms, of which 477 to 568 ms are in space"),
    ),
    "jitter, longer up, where a shared channel grants time; loss; no rain",
)

# MAX_WINDOW 33 and AIR_SPEED 128 make windows of 2046 ticks of 16 us = 32.7 ms, silences of 156 ticks = 2.5 ms, so a
# round of 70.4 ms, and 5 ticks per byte = 100 kbit/s. Packets begin in the first 30 ms, so that the last ends with the
# window. With the default AIR_SPEED 64 a stream of 40 packets of 100 bytes each way does not fit.
_RADIO = Preset(
    parse_spec("delay=35ms,loss=0.01,order=keep,rate=100kbps,limit=60,hold=30ms:40.4ms:70.4ms"),
    parse_spec("delay=35ms,loss=0.01,order=keep,rate=100kbps,limit=60,hold=0ms:35.2ms:70.4ms,hold=65.2ms:5.2ms:70.4ms"),
    "SiK telemetry radio, 57600 baud, 128 kbit/s in the air, half duplex, short windows (MAX_WINDOW 33)",
    (
        Claim("rtt_min_ms", 85.0, 95.0, "[SiK] each way 17.4 ms in each serial port and 8 ms in the air"),
        Claim("rtt_p99_ms", 85.0, 226.0, "[SiK] and each way waits for one round of 70.4 ms at most"),
    ),
    "loss; a buffer of 60 packets for 1850 bytes; windows are not given away when there is nothing to send",
)

CATALOGUE: Mapping[str, Preset] = MappingProxyType(
    {
        "perfect": _both("delay=0ms", "impairs nothing"),
        "lan": _both("delay=0.2ms", "a cable"),
        "jittery": _both("delay=5ms,jitter=uniform:28ms", "a loop of 10 to 66 ms: d = 1..3 at Ts = 25 ms"),
        "lossy": _both("delay=5ms,jitter=uniform:28ms,loss=0.03,dup=0.01", "jittery, and packets are lost and doubled"),
        "wifi": _WIFI,
        "lte": _LTE,
        "lte-drone": _LTE_DRONE,
        "5g": _5G,
        "leo": _LEO,
        "geo": _GEO,
        "radio": _RADIO,
    }
)
"""All presets by name."""

PRESETS: Mapping[str, tuple[LinkSpec, LinkSpec]] = MappingProxyType(
    {name: (preset.up, preset.down) for name, preset in CATALOGUE.items()}
)
"""Their links alone: (up, down) by name."""


class PresetRow(NamedTuple):
    """A preset as text."""

    name: str
    title: str
    up: str
    down: str
    source: str
    chosen: str


def preset_table() -> list[PresetRow]:
    """Return all presets as text: name, what it is, the SPEC of each direction, the sources, what was chosen here."""
    return [
        PresetRow(name, preset.title, format_spec(preset.up), format_spec(preset.down), preset.source, preset.chosen)
        for name, preset in CATALOGUE.items()
    ]


def parse_link(preset: str | None, up: str | None, down: str | None) -> tuple[LinkSpec, LinkSpec]:
    """Return (up, down) from ``--link``, ``--up`` and ``--down``.

    Parameters
    ----------
    preset : str or None
        A name of :data:`PRESETS` for both directions; None is ``perfect``.
    up, down : str or None
        A SPEC that takes the place of the preset's, per direction.

    Raises
    ------
    InputError
        On an unknown preset, or as :func:`parse_spec`.
    """
    name = "perfect" if preset is None else preset
    if name not in PRESETS:
        raise InputError(f"link preset: expected one of {', '.join(PRESETS)}, found {name or 'nothing'}")
    preset_up, preset_down = PRESETS[name]
    return (
        preset_up if up is None else parse_spec(up),
        preset_down if down is None else parse_spec(down),
    )
