"""The sensors that stream beside the tracker: a camera and an inertial sensor, real or simulated."""

from __future__ import annotations

from collections.abc import Mapping
from functools import partial
from pathlib import Path

from docking.assemble.simulated import FarEnd
from docking.assemble.transcribed import TranscribedDevice, TranscribedSpeed
from docking.config import CellFile, JobFile
from docking.config.base import PoseVector
from docking.config.instruments import InertialConfig, NdiConfig
from docking.config.live import StereoConfig
from docking.errors import BadArgument, FileUnreadable
from docking.live import LiveStreams
from docking.ports import InertialSensor, PointStream, SerialLink, SpeedLink
from docking.stereo_files import stereo_camera
from docking.transcript import TranscribedSerial, Transcript
from drivers.links.serial_port import SerialPort
from drivers.ndi_line import DEFAULT_BAUD
from drivers.ndi_stream import NdiStream
from drivers.pixel_pair import PixelPair
from drivers.vectornav import VectorNav
from sim.tracker.ndi import NdiCamera
from sim.tracker.pixel_pair import PixelPairComputer
from sim.tracker.plant_scene import PlantScene, mounted_pose, points_on_part
from sim.tracker.vectornav import VectorNavSensor
from sim.wires.pacing import DeviceEnd, SpeedEnd
from sim.wires.pty_serial import PtySerial, SteadyPty
from sim.wires.virtual_serial import VirtualSerial

CAMERA, INERTIAL = "camera", "inertial sensor"
LEVEL = (0.0, 0.0, 0.0, 180.0, 0.0, 0.0)
PLUGGED = "component"
"""The simulated camera has this tool on its port when none is configured."""


def camera_of(cell: CellFile, folder: Path, link: SpeedLink | None = None) -> PointStream:
    """The camera of the cell file, on its port or on `link`; tool definitions are sought from `folder`.

    Raises BadArgument where the cell has none, FileUnreadable for a definition that cannot be read.
    """
    config = _camera(cell)
    port = link if link is not None else SerialPort(config.port, DEFAULT_BAUD, CAMERA)
    return NdiStream(port, config, _definitions(config, folder), CAMERA)


def inertial_of(cell: CellFile, link: SerialLink | None = None) -> InertialSensor:
    """The inertial sensor of the cell file, on its port or on `link`. Raises BadArgument where the cell has none."""
    if cell.inertial is None:
        raise BadArgument(INERTIAL, "the cell has no inertial sensor")
    config = cell.inertial
    return VectorNav(link if link is not None else SerialPort(config.port, config.baud, INERTIAL), config, INERTIAL)


def simulated_camera(cell: CellFile, job: JobFile, folder: Path, far: FarEnd, wire: SpeedEnd) -> NdiCamera:
    """A camera before the plant of `far`: all its tools ride on the component, where `[live]` has them."""
    config = _camera(cell)
    roms = {rom: name for name, rom in _definitions(config, folder).items()}
    plugged = () if roms else (PLUGGED,)
    markers = tuple(target.name for target in job.component.targets)
    places = {point.name: point.at_mm for point in cell.live.points} if cell.live is not None else {}
    tools = {name: places.get(name, (0.0, 0.0, 0.0)) for name in (*roms.values(), *plugged)}
    scene = PlantScene(far.plant, config.station_pose, tools, markers)
    camera = NdiCamera(scene, wire, far.loop, roms, plugged, far.seed)
    camera.rate_hz = config.rate_hz
    far.devices.append(camera)
    return camera


def simulated_inertial(far: FarEnd, wire: DeviceEnd, mount: PoseVector = LEVEL) -> VectorNavSensor:
    """An inertial sensor on the component of `far`, its own axes at `mount` in the component frame."""
    sensor = VectorNavSensor(partial(mounted_pose, far.plant, mount), wire, far.loop, far.seed)
    far.devices.append(sensor)
    return sensor


def pair_of(config: StereoConfig, link: SerialLink) -> PixelPair:
    """The camera pair of the cell file on `link`."""
    first, second = (stereo_camera(one.name, one) for one in config.cameras)
    return PixelPair(link, (first, second), CAMERA)


def simulated_pair(cell: CellFile, job: JobFile, far: FarEnd, wire: DeviceEnd) -> None:
    """A camera pair before the plant of `far`: the targets of the part, and the points of `[live]` on it."""
    if cell.stereo is None:
        raise BadArgument(CAMERA, "the cell has no camera pair")
    points = {point.name: point.at_mm for point in cell.live.points} if cell.live is not None else {}
    targets = tuple(target.name for target in job.component.targets)
    scene = partial(points_on_part, far.plant, points, targets)
    pair = PixelPairComputer(scene, cell.stereo.cameras, wire, far.loop, cell.stereo.rate_hz, far.seed)
    far.devices.append(pair)


def _first_baud(cell: CellFile) -> int:
    """At which the line to the camera begins."""
    return DEFAULT_BAUD if cell.stereo is None else cell.stereo.baud


def virtual_streams(cell: CellFile, job: JobFile, folder: Path, far: FarEnd) -> LiveStreams:
    """Simulated sensors before and on the part of `far`, on lines inside the process, and their drivers."""
    line = VirtualSerial(far.loop, _first_baud(cell), CAMERA)
    if cell.stereo is not None:
        simulated_pair(cell, job, far, line.far)
        streams = LiveStreams(pair_of(cell.stereo, line.near))
    else:
        simulated_camera(cell, job, folder, far, line.far)
        streams = LiveStreams(camera_of(cell, folder, line.near))
    if cell.inertial is not None:
        line = VirtualSerial(far.loop, cell.inertial.baud, INERTIAL)
        simulated_inertial(far, line.far, cell.inertial.mount_pose)
        streams.inertial = inertial_of(cell, line.near)
    return streams


def stream_wires(cell: CellFile, job: JobFile, folder: Path, far: FarEnd) -> dict[str, str]:
    """The same on pseudo-terminals, each that the cell file has; where they are."""
    found = {}
    if (config := cell.stereo or cell.camera) is not None:
        wire: PtySerial = SteadyPty(far.loop, config.baud)
        wire.open()
        end = wire if far.transcript is None else TranscribedSpeed(wire, far.transcript, "camera")
        if cell.stereo is not None:
            simulated_pair(cell, job, far, end)
        else:
            simulated_camera(cell, job, folder, far, end)
        far.devices.append(wire)
        found["camera"] = wire.path
    if cell.inertial is not None:
        wire = PtySerial(far.loop, cell.inertial.baud)
        wire.open()
        at = wire if far.transcript is None else TranscribedDevice(wire, far.transcript, "inertial")
        simulated_inertial(far, at, cell.inertial.mount_pose)
        far.devices.append(wire)
        found["inertial"] = wire.path
    return found


def streams_of(
    cell: CellFile, folder: Path, found: Mapping[str, object], transcript: Transcript | None = None
) -> LiveStreams:
    """The sensors of the cell file, on their ports or on those of simulated devices; `transcript` gets all bytes."""
    streams = LiveStreams(_camera_at(cell, folder, camera_port(cell, found), transcript))
    if cell.inertial is not None:
        streams.inertial = _inertial_at(cell, cell.inertial, inertial_port(cell.inertial, found), transcript)
    return streams


Sensor = tuple[str, str, PointStream | InertialSensor]


def sensors_of(
    cell: CellFile, folder: Path, found: Mapping[str, object], transcript: Transcript | None = None
) -> list[Sensor]:
    """Every sensor of the cell file that streams, whether `[live]` uses it or not: name, port, driver.

    Raises FileUnreadable for a tool definition that cannot be read.
    """
    sensors: list[Sensor] = []
    if cell.stereo is not None or cell.camera is not None:
        port = camera_port(cell, found)
        sensors.append((CAMERA, port, _camera_at(cell, folder, port, transcript)))
    if cell.inertial is not None:
        port = inertial_port(cell.inertial, found)
        sensors.append((INERTIAL, port, _inertial_at(cell, cell.inertial, port, transcript)))
    return sensors


def camera_port(cell: CellFile, found: Mapping[str, object]) -> str:
    return str(found.get("camera", (cell.stereo or _camera(cell)).port))


def inertial_port(config: InertialConfig, found: Mapping[str, object]) -> str:
    return str(found.get("inertial", config.port))


def _heard(link: SerialPort, transcript: Transcript | None, wire: str) -> SpeedLink:
    return link if transcript is None else TranscribedSerial(link, transcript, wire)


def _camera_at(cell: CellFile, folder: Path, port: str, transcript: Transcript | None) -> PointStream:
    link = _heard(SerialPort(port, _first_baud(cell), CAMERA), transcript, "camera")
    return pair_of(cell.stereo, link) if cell.stereo is not None else camera_of(cell, folder, link)


def _inertial_at(cell: CellFile, config: InertialConfig, port: str, transcript: Transcript | None) -> InertialSensor:
    return inertial_of(cell, _heard(SerialPort(port, config.baud, INERTIAL), transcript, "inertial"))


def _camera(cell: CellFile) -> NdiConfig:
    if cell.camera is None:
        raise BadArgument(CAMERA, "the cell has no camera")
    return cell.camera


def _definitions(config: NdiConfig, folder: Path) -> dict[str, bytes]:
    """Definition of each configured tool, without the zeros that fill its last block."""
    found = {}
    for tool in config.tools:
        path = folder / tool.rom
        try:
            found[tool.name] = path.read_bytes().rstrip(b"\0")
        except OSError as error:
            raise FileUnreadable(str(path), error.strerror or str(error)) from error
    return found
