"""Files of cameras as Metashape and Pix4D write them, of cameras that are known, and their own equations of the lens."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np

WGS_84 = 'GEOGCS["WGS 84",DATUM["World Geodetic System 1984",SPHEROID["WGS 84",6378137,298.257223563]],UNIT["degree",0.01745]]'
LOCAL = 'LOCAL_CS["Local Coordinates (m)",LOCAL_DATUM["Local Datum",0],UNIT["metre",1]]'
UTM = (
    'PROJCS["WGS 84 / UTM zone 32N",GEOGCS["WGS 84",DATUM["WGS_1984",SPHEROID["WGS 84",6378137,298.257223563]],'
    'UNIT["degree",0.0174532925199433]],PROJECTION["Transverse_Mercator"],UNIT["metre",1]]'
)
# Of a 40x32 image, as a thermal camera with a wide lens has them.
METASHAPE = {"f": 38.0, "cx": 1.25, "cy": -0.75, "k1": -0.21, "k2": 0.06, "k3": -0.008, "p1": 0.004, "p2": -0.002}
PIX4D = {"f": 38.0, "cx": 21.25, "cy": 15.25, "radial": (-0.21, 0.06, -0.008), "tangential": (0.004, -0.002)}


def geocentric(place: Sequence[float]) -> np.ndarray:
    """Metres [3] from the middle of the earth of a latitude and longitude in degrees and a height (WGS 84)."""
    (latitude, longitude), height = np.radians(place[:2]), place[2]
    axis, flat = 6378137.0, (2 - 1 / 298.257223563) / 298.257223563
    normal = axis / np.sqrt(1 - flat * np.sin(latitude) ** 2)
    around = (normal + height) * np.cos(latitude)
    return np.array([
        around * np.cos(longitude), around * np.sin(longitude), (normal * (1 - flat) + height) * np.sin(latitude)
    ])  # fmt: skip


def east_north_up_at(place: Sequence[float]) -> np.ndarray:
    """Directions [3, 3] of east, north and up, one a row: how places move with longitude, latitude and height."""
    steps = np.array([[0, 1e-4, 0], [1e-4, 0, 0], [0, 0, 10.0]])
    moved = np.stack([geocentric(place + step) - geocentric(place - step) for step in steps])
    return moved / np.linalg.norm(moved, axis=1, keepdims=True)


def calibration(
    values: Mapping[str, float], size: tuple[int, int] = (40, 32), kind: str = "frame", of: str = "adjusted"
) -> str:
    """XML of a calibration of Metashape."""
    numbers = "".join(f"<{key}>{value!r}</{key}>" for key, value in values.items())
    return f'<calibration type="{kind}" class="{of}"><resolution width="{size[0]}" height="{size[1]}"/>{numbers}</calibration>'


def transform_of(rotation: np.ndarray, shift: np.ndarray, scale: float) -> str:
    """XML of a transform of Metashape's chunk."""
    return (
        f'<transform><rotation locked="true">{numbers(rotation)}</rotation><translation>{numbers(shift)}</translation>'
        f'<scale locked="true">{scale!r}</scale></transform>'
    )


def camera(index: int, label: str, pose: np.ndarray | None, more: str = 'sensor_id="0" component_id="0"') -> str:
    """XML of a camera of Metashape with a camera-to-chunk pose [4, 4], or without one."""
    inner = "" if pose is None else f"<transform>{numbers(pose)}</transform><orientation>1</orientation>"
    return f'<camera id="{index}" {more} label="{label}">{inner}<reference x="7" y="51" z="1" enabled="true"/></camera>'


def write_metashape(
    path: Path, cameras: Sequence[str], sensors: Sequence[str], transform: str = "", reference: str = "", more: str = ""
) -> Path:
    """A cameras.xml of parts; half of the cameras lie in a group."""
    listed = "".join(
        f'<sensor id="{i}" label="camera" type="frame">{inner}</sensor>' for i, inner in enumerate(sensors)
    )
    half = len(cameras) // 2
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(
        '<?xml version="1.0" encoding="UTF-8"?>\n<document version="2.0.0"><chunk label="Chunk 1" enabled="true">'
        f'<sensors next_id="9">{listed}</sensors><components next_id="1" active_id="0"><component id="0" label="Component 1">'
        f'{transform}</component>{more}</components><cameras next_id="99">{"".join(cameras[:half])}<group id="0" '
        f'label="flight">{"".join(cameras[half:])}</group></cameras><reference>{reference.replace(chr(34), "&quot;")}</reference>'
        "</chunk></document>\n"
    )
    return path


def in_chunk(viewmat: np.ndarray, rotation: np.ndarray, shift: np.ndarray, scale: float) -> np.ndarray:
    """Camera-to-chunk pose [4, 4] of a world-to-camera one, where the transform leads from the chunk to the world."""
    pose = np.linalg.inv(viewmat)
    pose[:3, 3] = rotation.T @ (pose[:3, 3] - shift) / scale
    pose[:3, :3] = rotation.T @ pose[:3, :3]
    return pose


def seen_by_metashape(values: Mapping[str, float], points: np.ndarray, size: tuple[int, int] = (40, 32)) -> np.ndarray:
    """Pixels [n, 2] from the corner of the image of points [n, 3] in camera axes, by the equations of its manual."""
    v = dict.fromkeys(("k1", "k2", "k3", "k4", "p1", "p2", "b1", "b2"), 0.0) | dict(values)
    x, y = points[:, 0] / points[:, 2], points[:, 1] / points[:, 2]
    r2 = x * x + y * y
    radial = 1 + v["k1"] * r2 + v["k2"] * r2**2 + v["k3"] * r2**3 + v["k4"] * r2**4
    xd = x * radial + v["p1"] * (r2 + 2 * x * x) + 2 * v["p2"] * x * y
    yd = y * radial + v["p2"] * (r2 + 2 * y * y) + 2 * v["p1"] * x * y
    across = size[0] * 0.5 + v["cx"] + xd * v["f"] + xd * v["b1"] + yd * v["b2"]
    return np.column_stack([across, size[1] * 0.5 + v["cy"] + yd * v["f"]])


def write_pix4d(
    folder: Path,
    viewmats: Mapping[str, np.ndarray],
    offset: Sequence[float] | None = None,
    projection: str = "",
    **changed,
) -> Path:
    """*_calibrated_camera_parameters.txt of cameras in the axes of its projection, and the files beside it."""
    v = PIX4D | changed
    lines = ["fileName imageWidth imageHeight ", "camera matrix K [3x3]", "radial distortion [3x1]",
             "tangential distortion [2x1]", "camera position t [3x1]", "camera rotation R [3x3]",
             "camera model m = K [R|-Rt] X", ""]  # fmt: skip
    for name, viewmat in viewmats.items():
        lines += [f"{name} 40 32", f"{v['f']!r} {v.get('skew', 0)!r} {v['cx']!r}", f"0 {v['f']!r} {v['cy']!r}", "0 0 1"]
        lines += [numbers(v["radial"]), numbers(v["tangential"]), numbers(np.linalg.inv(viewmat)[:3, 3])]
        lines += [numbers(row) for row in viewmat[:3, :3]] + [""]
    folder.mkdir(parents=True, exist_ok=True)
    path = folder / "flight_calibrated_camera_parameters.txt"
    path.write_text("\n".join(lines))
    if offset is not None:
        (folder / "flight_offset.xyz").write_text(" ".join(f"{x:.3f}" for x in offset))
    if projection:
        (folder / "flight_wkt.prj").write_text(projection)
    return path


def seen_by_pix4d(points: np.ndarray) -> np.ndarray:
    """Pixels [n, 2] of points [n, 3] in camera axes, by the equations that Pix4D documents."""
    x, y = points[:, 0] / points[:, 2], points[:, 1] / points[:, 2]
    (r1, r2, r3), (t1, t2), r = PIX4D["radial"], PIX4D["tangential"], np.hypot(x, y)
    radial = 1 + r1 * r**2 + r2 * r**4 + r3 * r**6
    xd = radial * x + 2 * t1 * x * y + t2 * (r**2 + 2 * x**2)
    yd = radial * y + 2 * t2 * x * y + t1 * (r**2 + 2 * y**2)
    return np.column_stack([PIX4D["f"] * xd + PIX4D["cx"], PIX4D["f"] * yd + PIX4D["cy"]])


def numbers(values: np.ndarray | Sequence[float]) -> str:
    """Numbers with all their digits, blanks between them."""
    return " ".join(repr(float(value)) for value in np.asarray(values).ravel())
