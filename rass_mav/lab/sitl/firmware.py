"""The firmware that flies: where it is found, and how a vehicle is started with it."""

from __future__ import annotations

import re
import shutil
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Literal, NamedTuple

from rass_mav.app.shipped import shipped
from rass_mav.errors import ConfigError
from rass_mav.lab.fleet.air_server import Ports
from rass_mav.lab.fleet.tether import become_arguments
from rass_mav.lab.sitl.mock_copter import GUIDED
from rass_mav.lab.sitl.scenario import FlightScenario
from rass_mav.lab.swarm.autopilot import ORIGIN, to_earth
from rass_mav.lab.swarm.scenario import system_id

Name = Literal["arducopter", "px4", "mock"]

#: The last PX4 instance with its own port; later ones share a port.
MAX_PX4 = 9
#: Advice for a person who has no firmware.
HOW_TO_GET = (
    "no arducopter or px4 on PATH. ArduCopter: build it (./waf configure --board sitl && ./waf copter, the binary is"
    " build/sitl/bin/arducopter) or download one for Linux from firmware.ardupilot.org. PX4: install the px4 package of"
    " its releases, or build it (make px4_sitl_sih). Then put it on PATH, or use --binary"
)
_SCRIPT = "rass_rad.lua"


class Firmware(NamedTuple):
    """The firmware that flies the vehicles."""

    name: Name
    command: tuple[str, ...]
    """The program, and its fixed arguments."""
    script: Path | None = None
    """ArduPilot: the Lua script that simulates readings; None: readings come from elsewhere."""


def find_firmware(
    binary: str | None = None, kind: Literal["arducopter", "px4"] | None = None, *, mock: bool = False
) -> Firmware | None:
    """The firmware to fly with; None: there is none on PATH (`HOW_TO_GET` explains what to do).

    `binary`: its path or name. `kind`: its kind; None: PX4 if its name contains px4. `mock`: use the mock.
    Raises `ConfigError` if the named binary does not exist.
    """
    if mock:
        return Firmware("mock", (sys.executable, "-m", "rass_mav.lab.sitl.mock_copter"))
    wanted = [binary] if binary is not None else [kind] if kind is not None else ["arducopter", "px4"]
    for name in wanted:
        found = shutil.which(name)
        if found is None:
            continue
        if (kind or ("px4" if "px4" in Path(name).name else "arducopter")) == "px4":
            # PX4 looks for its modules beside the real file, not beside a link to it.
            return Firmware("px4", (str(Path(found).resolve()),))
        return Firmware("arducopter", (str(Path(found).absolute()),), shipped(_SCRIPT))
    if binary is not None:
        raise ConfigError(f"--binary {binary}: no such program, or no permission to run it")
    return None


def prepare(
    firmware: Firmware, scenario: FlightScenario, ports: Ports, node: int, directory: Path, *, scripted: bool
) -> list[str]:
    """Write a vehicle's files, and return the arguments of the Python interpreter that start it.

    `directory`: a new one, for this vehicle. `scripted`: its script simulates readings. Raises `ConfigError`.
    """
    directory.mkdir()
    if firmware.name == "px4":
        return _px4(firmware.command, scenario, node, directory)
    parameters = directory / "rass.parm"
    parameters.write_text(arducopter_parameters(system_id(node), scripted=scripted), encoding="ascii")
    if scripted:
        assert firmware.script is not None
        scripts = directory / "scripts"
        scripts.mkdir()
        text = firmware.script.read_text(encoding="utf-8")
        (scripts / _SCRIPT).write_text(made_up_readings(text, scenario, node), encoding="utf-8")
    latitude, longitude = to_earth(*scenario.places[node])
    command = [
        *firmware.command,
        "--model", "quad",
        "--instance", str(node),
        "--home", f"{latitude:.7f},{longitude:.7f},{ORIGIN[2]:g},0",
        "--defaults", str(parameters),
    ]  # fmt: skip
    for number, of in enumerate((ports.serial0, ports.serial1, ports.serial2)):
        command += [f"--serial{number}", f"udpclient:127.0.0.1:{of[node]}"]
    # The mock writes no files, and finds its modules in our own working directory.
    return become_arguments("." if firmware.name == "mock" else str(directory), {}, command)


def arducopter_parameters(own_id: int, *, scripted: bool) -> str:
    """The defaults file of a vehicle, with NAME VALUE on each line. The firmware ignores unknown names."""
    values: dict[str, float] = {
        # Up to ArduPilot 4.6, and since 4.7.
        "SYSID_THISMAV": own_id,
        "MAV_SYSID": own_id,
        "FRAME_CLASS": 1,
        "FRAME_TYPE": 0,
        **{f"SERIAL{port}_PROTOCOL": 2 for port in range(3)},
        # The ground station's port does not forward. Otherwise MAVSDK would be on the air as well.
        "SERIAL0_OPTIONS": 1024,
        "MAV1_OPTIONS": 2,
        # Motors start in guided mode, which needs a position, and stay on until the mission begins. Without a mode
        # channel, the simulated radio control cannot leave that mode.
        "INITIAL_MODE": GUIDED,
        "FLTMODE_CH": 0,
        "DISARM_DELAY": 0,
        "AUTO_OPTIONS": 3,
        # There is no radio control, and nobody can be hurt.
        "FS_THR_ENABLE": 0,
        "FS_GCS_ENABLE": 0,
        "ARMING_CHECK": 0,
        "ARMING_SKIPCHK": -1,
        # The offsets of the simulated compasses.
        **{
            f"COMPASS_OFS{n}_{axis}": off for n in ("", "2", "3") for axis, off in zip("XYZ", (5, 13, -18), strict=True)
        },
        "SCR_ENABLE": int(scripted),
    }
    return "".join(f"{name} {value}\n" for name, value in values.items())


def made_up_readings(script: str, scenario: FlightScenario, node: int) -> str:
    """`rass_rad.lua` with other defaults: the scenario's source, relative to a vehicle's home.

    A script's parameters cannot be set before its first run, and this script chooses its source when it starts.
    Raises `ConfigError` for a script without these parameters.
    """
    ((x, y, intensity),) = scenario.sources
    start = scenario.places[node]
    defaults = {
        "SOURCE": 3,
        "NORTH": y - start[1],
        "EAST": x - start[0],
        "CPS": intensity,
        "DECAY": scenario.radiation.decay,
        "BACK": 0,
    }
    for name, value in defaults.items():
        script, count = re.subn(rf'\{{ "{name}", [^}}]* \}}', f'{{ "{name}", {value:g} }}', script)
        if count != 1:
            raise ConfigError(f"{_SCRIPT}: expected one parameter {name}, found {count}")
    return script


def _px4(command: Sequence[str], scenario: FlightScenario, node: int, directory: Path) -> list[str]:
    if node > MAX_PX4:
        raise ConfigError(f"nodes: expected at most {MAX_PX4 + 1} with PX4, whose later vehicles share a port")
    files = Path(command[0]).parents[1] / "etc"
    if not files.is_dir():
        raise ConfigError(f"{command[0]}: expected PX4's files in {files}")
    latitude, longitude = to_earth(*scenario.places[node])
    variables = {
        "PX4_SIM_MODEL": "sihsim_quadx",
        "PX4_HOME_LAT": f"{latitude:.7f}",
        "PX4_HOME_LON": f"{longitude:.7f}",
        "PX4_HOME_ALT": f"{ORIGIN[2]:g}",
        # There is no radio control; motors stay on until the mission begins.
        "PX4_PARAM_COM_RC_IN_MODE": "4",
        "PX4_PARAM_NAV_DLL_ACT": "0",
        "PX4_PARAM_COM_DISARM_PRFLT": "-1",
    }
    # Instance k has the system id k + 1.
    return become_arguments(
        str(directory), variables, [*command, "-d", "-i", str(node), "-w", str(directory), str(files)]
    )
