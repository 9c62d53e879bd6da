"""JSBSim itself: found, silent, with an aircraft loaded and trimmed.

JSBSim comes with the extra ``lagproof[jsbsim]``. Its aircraft files may ask for sockets and for output files, which
JSBSim opens as it loads them; so it is given a copy of the aircraft's folder without either. What it has to say goes
to a logger instead of standard output, and the end of it into the complaint when there is no trim.
"""

from __future__ import annotations

import difflib
import math
import shutil
import tempfile
from collections import deque
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING, Any, cast
from xml.etree import ElementTree

from gains.table import InputError

if TYPE_CHECKING:
    import jsbsim

__all__ = ["FOOT", "GROUND_M", "SURFACE", "aircraft_file", "aircraft_names", "jsbsim_package", "trimmed"]

FOOT = 0.3048
SURFACE = "fcs/elevator-pos-rad"
"""The elevator's surface: what the aerodynamics of nearly all aircraft read."""
GROUND_M = 3.0
"""Lower than this above the ground nothing flies."""
MAX_LOG = 4
"""Messages of JSBSim that are kept; older ones are forgotten."""


def aircraft_names() -> list[str]:
    """Return the aircraft that JSBSim comes with.

    Raises
    ------
    InputError
        When JSBSim is not installed.
    """
    folders = (_root() / "aircraft").iterdir()
    return sorted(folder.name for folder in folders if (folder / f"{folder.name}.xml").is_file())


def aircraft_file(aircraft: str) -> Path:
    """Return the file of an aircraft.

    Raises
    ------
    InputError
        When JSBSim has none of this name, or is not installed.
    """
    known = aircraft_names()
    if aircraft not in known:
        spelt = {name.lower(): name for name in known}
        near = difflib.get_close_matches(aircraft.lower(), spelt, 3)
        hint = f"; did you mean {', '.join(spelt[name] for name in near)}?" if near else ""
        raise InputError(f"jsbsim:{aircraft}: expected an aircraft that JSBSim has, found no such one{hint}")
    return _root() / "aircraft" / aircraft / f"{aircraft}.xml"


def trimmed(
    aircraft: str, *, vc_kts: float | None, airspeed_m_s: float | None, altitude_m: float, dt_s: float
) -> jsbsim.FGFDMExec:
    """Load an aircraft and trim it in level flight, its engines running, its fuel never less.

    Parameters
    ----------
    aircraft : str
        A name of JSBSim.
    vc_kts, airspeed_m_s : float or None
        Calibrated airspeed in knots, or true airspeed; one of them.
    altitude_m : float
        Above sea level.
    dt_s : float
        JSBSim's own step.

    Raises
    ------
    InputError
        When there is no such aircraft, or no such trim.
    """
    if (vc_kts is None) == (airspeed_m_s is None):
        raise InputError(f"jsbsim:{aircraft}: expected a calibrated or a true airspeed, found both or none")
    fdm = _loaded(aircraft)
    fdm.set_dt(dt_s)
    fdm["ic/h-sl-ft"] = altitude_m / FOOT
    if vc_kts is not None:
        fdm["ic/vc-kts"], speed = vc_kts, f"{vc_kts:g} kt"
    elif airspeed_m_s is not None:
        fdm["ic/vt-fps"], speed = airspeed_m_s / FOOT, f"{airspeed_m_s:g} m/s"
    fdm["ic/gamma-deg"] = 0.0
    where = f"jsbsim:{aircraft}: expected a trim in level flight at {speed} and {altitude_m:.0f} m"
    package, log = jsbsim_package(), _logger()
    if log is not None:
        log.lines.clear()
    try:
        fdm.run_ic()
        fdm["propulsion/set-running"] = -1
        fdm["simulation/do_simple_trim"] = 1
    except (package.TrimFailureError, package.BaseError) as failure:
        said = dict.fromkeys(" ".join(each.split()) for each in [str(failure), *([] if log is None else log.lines)])
        raise InputError(f"{where}, found none: {'; '.join(filter(None, said))}") from None
    if not math.isfinite(fdm["aero/alpha-rad"]) or fdm["position/h-agl-ft"] * FOOT < GROUND_M:
        raise InputError(f"{where}, found the ground there")
    fdm["propulsion/fuel_freeze"] = 1
    return fdm


def _loaded(aircraft: str) -> jsbsim.FGFDMExec:
    """Return JSBSim with an aircraft, which can neither talk to the network nor write files."""
    package, source, root = jsbsim_package(), aircraft_file(aircraft), _root()
    where = f"jsbsim:{aircraft}: expected an aircraft that JSBSim can load"
    if (log := _logger()) is not None:
        package.set_logger(log)  # one per thread
    with tempfile.TemporaryDirectory(prefix="lagproof-") as folder:
        copy = Path(folder) / aircraft
        shutil.copytree(source.parent, copy)
        _without_sockets_and_files(copy / source.name)
        fdm = package.FGFDMExec(str(root))
        fdm.set_debug_level(0)
        try:
            loaded = fdm.load_model_with_paths(aircraft, folder, str(root / "engine"), str(root / "systems"))
        except package.BaseError as failure:
            raise InputError(f"{where}, found {' '.join(str(failure).split())}") from None
    if not loaded:
        raise InputError(f"{where}, found that it cannot")
    return cast("jsbsim.FGFDMExec", fdm)


def _without_sockets_and_files(path: Path) -> None:
    """Take what opens sockets and output files out of an aircraft's file."""
    tree = ElementTree.parse(path)
    top = tree.getroot()
    for element in [*top.findall("input"), *top.findall("output")]:
        top.remove(element)
    tree.write(path, encoding="utf-8", xml_declaration=True)


@cache
def jsbsim_package() -> Any:
    """Return JSBSim, silent.

    Raises
    ------
    InputError
        When it is not installed.
    """
    try:
        import jsbsim
    except ImportError:
        raise InputError("jsbsim: expected it to be installed: pip install 'lagproof[jsbsim]'") from None
    package: Any = jsbsim
    package.FGJSBBase().debug_lvl = 0  # else it prints a banner
    return package


@cache
def _logger() -> Any:
    """Return what keeps the messages of JSBSim from standard output; None for a JSBSim that has no loggers yet."""
    if not hasattr(jsbsim_package(), "set_logger"):
        return None
    import jsbsim

    class Logger(jsbsim.FGLogger):
        def __init__(self) -> None:
            super().__init__()
            self.lines: deque[str] = deque(maxlen=MAX_LOG)

        def set_level(self, level: object) -> None:
            """Begin a message."""

        def file_location(self, filename: str, line: int) -> None:
            """Hear where a message comes from."""

        def message(self, message: str) -> None:
            """Keep a message, or a part of one."""
            self.lines.append(message)

        def format(self, format: object) -> None:
            """Hear how a message shall look."""

        def flush(self) -> None:
            """End a message."""

    return Logger()


def _root() -> Path:
    return Path(jsbsim_package().get_default_root_dir())
