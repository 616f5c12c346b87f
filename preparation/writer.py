"""A prepared folder, frame by frame: an image, beside it all that is known of it, and nothing half-written.

A frame is done when its .json stands beside its image and was made of the same file with the same settings. So a preparation
that was stopped goes on where it was, and one with another emissivity makes the images anew.
"""

from __future__ import annotations

import json
import os
import shlex
import shutil
from collections.abc import Mapping, Sequence
from dataclasses import asdict, fields, replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import torch

from heatsplat.contracts import SceneError, evenly_spread
from heatsplat.datamodules.bounds import BOUNDS_FILE, BOUNDS_TABLE, LOWER, NAMES, UPPER
from heatsplat.datamodules.colmap import FRAMES_FILE, WORLD_FILE
from heatsplat.datamodules.formats.images import SUFFIXES, read_grey
from heatsplat.datamodules.formats.radiometric import Calibration, surface_celsius
from heatsplat.datamodules.side_files import read_table
from heatsplat.datamodules.timestamps import instant
from heatsplat.doctor.base import some
from heatsplat.io.files import read_json_object, write_atomically
from heatsplat.io.tables import write_csv
from heatsplat.io.tiff import write_temperature
from heatsplat.physics.defects import dead_pixels
from heatsplat.physics.radiometry import LIMITS, Conditions, PlanckResponse, measured_signal, uncertainty
from heatsplat.physics.units import KELVIN_AT_0_C
from heatsplat.preparation.conditions import InputUncertainty
from heatsplat.preparation.devices import devices_of
from heatsplat.preparation.fingerprint import fingerprint
from heatsplat.preparation.frame import Position, ThermalFrame
from heatsplat.preparation.target import PARTIAL

QUANTILES = np.linspace(0.0, 1.0, 41)
EAST_NORTH_UP = "east, north, up"  # axes of a world that GPS has placed
ENDINGS = ("png", "tiff")  # of images of greys, of temperatures
DEAD_FRAMES = 8  # frames that dead pixels are judged from


class Writer:
    """Writes the frames of a recording into a folder.

    Args:
        target: the prepared folder.
        uncertain: how sure the conditions are.
        keep_counts: also write the numbers as the camera stored them, as 16-bit PNG in counts/.
    """

    def __init__(self, target: Path, uncertain: InputUncertainty, keep_counts: bool) -> None:
        self.target, self.uncertain, self.keep_counts = target, uncertain, keep_counts
        self.images = target / "images"
        # By name of a frame: [H, W] bool, pixels of its detector that say nothing.
        self.dead: dict[str, np.ndarray] = {}
        # By name of a frame: masks in the folder that no preparation made, greys.
        self.drawn: dict[str, np.ndarray] = {}

    def check(self, frames: Sequence[ThermalFrame]) -> None:
        """Raises SceneError where the folder holds images of another recording, or there are no counts to keep."""
        if self.keep_counts and not any(d.frames[0].load().dtype == np.uint16 for d in devices_of(frames)):
            raise SceneError(
                f"keep_counts=true changes nothing: files such as {frames[0].path} hold no 16-bit counts; leave it out"
            )
        ours = {frame.name for frame in frames}
        there = (p for p in sorted(self.images.glob("*")) if p.suffix.lower() in SUFFIXES)
        if foreign := [p.name for p in there if p.stem not in ours]:
            raise SceneError(
                f"{self.images} holds {len(foreign)} images that are no frames of this recording: {some(foreign)}. If their "
                f"files were taken out of the source, delete {self.images}, which is then written anew (rm -r "
                f"{shlex.quote(str(self.images))}); else give an empty folder as target"
            )

    def image_of(self, frame: ThermalFrame) -> Path:
        """Its file in the prepared folder."""
        return self.images / image_name(frame)

    def write(self, frame: ThermalFrame) -> tuple[dict[str, Any], bool]:
        """The record of a frame, and whether its image had to be written."""
        record_file, made_of = self.images / f"{frame.name}.json", self._made_of(frame)
        done = read_json_object(record_file) or {}
        mask = read_grey(self._mask_of(image_name(frame)))
        if mask is not None and np.count_nonzero(mask == 0) != done.get("dead_pixels", 0):
            self.drawn[frame.name] = mask
        if done.get("made_of") == made_of and self.image_of(frame).exists():
            return done, False
        stored = frame.load()
        pixels = replace(frame, load=lambda: stored).pixels()
        if frame.calibration is None:
            self._replace(self.image_of(frame), cv2.imencode(".png", stored)[1])
        else:
            partial = self.target / PARTIAL / f"{frame.name}.tiff"
            write_temperature(partial, pixels)
            self.images.mkdir(parents=True, exist_ok=True)
            os.replace(partial, self.image_of(frame))
        if self.keep_counts and stored.dtype == np.uint16:
            self._replace(self.target / "counts" / f"{frame.name}.png", cv2.imencode(".png", stored)[1])
        if frame.picture is not None and (photo := frame.picture()):
            self._replace(self.photo_of(frame), photo)
        if (before := done.get("file")) in {f"{frame.name}.{end}" for end in ENDINGS} - {image_name(frame)}:
            # Greys that have become temperatures, or the other way round: two images of one name would be taken for each other.
            (self.images / before).unlink(missing_ok=True)
            self._mask_of(before).unlink(missing_ok=True)
        if done.get("dead_pixels") and frame.name not in self.dead and frame.name not in self.drawn:
            # A mask of ours, which would leave out pixels that are sound again.
            self._mask_of(image_name(frame)).unlink(missing_ok=True)
        record = self._record(frame, pixels) | {"made_of": made_of}
        write_atomically(record_file, json.dumps(record, indent=1, allow_nan=False) + "\n")
        return record, True

    def photo_of(self, frame: ThermalFrame) -> Path:
        """Where the photo inside a frame's file goes."""
        return self.target / "visible" / f"{frame.name}.jpg"

    @staticmethod
    def _replace(path: Path, content: Any) -> None:
        write_atomically(path, memoryview(np.frombuffer(content, np.uint8)))

    def _made_of(self, frame: ThermalFrame) -> str:
        file = frame.path.stat()
        dead = np.flatnonzero(self.dead[frame.name]).tolist() if frame.name in self.dead else []
        return fingerprint(frame, file.st_size, file.st_mtime_ns, self.keep_counts, self.uncertain, dead)

    def _record(self, frame: ThermalFrame, pixels: np.ndarray) -> dict[str, Any]:
        finite = np.isfinite(pixels)
        known = pixels[finite & ~self.dead[frame.name] if frame.name in self.dead else finite]
        record: dict[str, Any] = {
            "file": self.image_of(frame).name,
            "source": str(frame.path),
            "number": frame.number,
            "size": [pixels.shape[1], pixels.shape[0]],
            "time": frame.time.isoformat() if frame.time else None,
            "camera": asdict(frame.camera),
            "position": asdict(frame.position) if frame.position else None,
            "attitude": asdict(frame.attitude) if frame.attitude else None,
            "photo": str(self.photo_of(frame) if frame.picture is not None else frame.rgb or "") or None,
            "unknown_pixels": int((~finite).sum()),
            "dead_pixels": int(self.dead[frame.name].sum()) if frame.name in self.dead else 0,
            "quantiles": [float(q) for q in np.quantile(known.astype(np.float64), QUANTILES)] if known.size else None,
        }
        if frame.calibration is None:
            return record
        record["calibration"] = calibration_as_json(frame.calibration)
        standard = self.uncertain.standard(frame.conditions)
        record["conditions"] = {
            name: {
                "value": float(getattr(frame.conditions, name)),
                "from": frame.sources.get(name, "nowhere: no correction"),
                "standard_uncertainty": standard[name],
            }
            for name in LIMITS
        }
        record["atmosphere"] = asdict(frame.conditions.atmosphere)
        record["transmittance"] = float(frame.conditions.transmittance())
        if known.size:
            median = float(np.median(known))
            parts = uncertainty_at(median, frame.calibration, frame.conditions, standard)
            record["uncertainty_c"] = {"at_c": median} | {n: x if np.isfinite(x) else None for n, x in parts.items()}
        return record

    def find_dead_pixels(self, frames: Sequence[ThermalFrame]) -> int:
        """How many pixels of the detector (of each camera's) are dead; from here on no record counts them."""
        count = 0
        for device in devices_of(frames):
            own = device.frames
            few = [own[i].pixels().astype(np.float32) for i in evenly_spread(len(own), DEAD_FRAMES)]
            dead = dead_pixels(torch.from_numpy(np.stack(few))).numpy()
            if dead.any():
                self.dead |= dict.fromkeys((frame.name for frame in own), dead)
                count += int(dead.sum())
        return count

    def write_masks(self, frames: Sequence[ThermalFrame]) -> None:
        """Leaves dead pixels out of every image: masks/ (white counts). Masks that were drawn leave out what they did, too."""
        for frame in frames:
            if frame.name in self.dead:
                mask = np.where(self.dead[frame.name], 0, 255).astype(np.uint8)
                drawn = self.drawn.get(frame.name, mask)
                if drawn.shape == mask.shape:
                    self._replace(self._mask_of(image_name(frame)), cv2.imencode(".png", np.minimum(mask, drawn))[1])

    def _mask_of(self, image: str) -> Path:
        return self.target / "masks" / f"{image}.png"

    def finish(self, frames: Sequence[ThermalFrame], records: Sequence[Mapping[str, Any]]) -> None:
        """Writes what belongs to the recording as a whole: frames.csv, and temperature_bounds.json or .csv."""
        shutil.rmtree(self.target / PARTIAL, ignore_errors=True)
        write_csv(self.target / FRAMES_FILE, rows(frames, records))
        found = [
            r["quantiles"] for f, r in zip(frames, records, strict=True) if f.calibration is not None and r["quantiles"]
        ]
        if spans := {image_name(frame): span_of(frame) for frame in frames if frame.span is not None}:
            write_spans(self.target, spans)
        elif found:
            low, high = min(q[0] for q in found), max(q[-1] for q in found)
            write_bounds(self.target, low, max(high, low + 1e-3))
        else:  # bounds of an earlier preparation would make temperatures of greys
            for name in (BOUNDS_FILE, BOUNDS_TABLE):
                (self.target / name).unlink(missing_ok=True)


def image_name(frame: ThermalFrame) -> str:
    """Name of a frame's image in a prepared folder: float32 TIFF in °C, PNG for greys."""
    return f"{frame.name}.{ENDINGS[frame.calibration is not None]}"


def write_world(target: Path, metres_per_unit: float | None, axes: str | None = None) -> None:
    """Says in a prepared folder how long one unit of its world is; None takes away what an earlier search said.

    Args:
        target: the prepared folder.
        metres_per_unit: metres of one unit, or None where that is not known.
        axes: directions of the world's axes, such as "east, north, up"; None where they are not known.
    """
    path = target / WORLD_FILE
    if metres_per_unit is None:
        path.unlink(missing_ok=True)
    else:
        world = {"metres_per_unit": metres_per_unit} | ({"axes": axes} if axes else {})
        write_atomically(path, json.dumps(world) + "\n")


def write_places(target: Path, places: Mapping[str, Sequence[float]]) -> None:
    """Puts where cameras were found to stand in the place of where the camera's files say so, in a folder's table of frames.

    Args:
        target: the prepared folder, with its frames.csv.
        places: name of an image -> latitude and longitude in degrees (WGS 84), altitude in metres.
    """
    table = read_table(target / FRAMES_FILE)
    found = []
    for _, cells in table.rows:
        row = dict(zip(table.columns, cells, strict=True))
        row |= {part.name: "" for part in fields(Position)}  # none of two kinds of places in one table
        place = places.get(row["file"])
        if place is not None:
            row |= dict(zip(("latitude_deg", "longitude_deg", "altitude_m"), map(float, place), strict=True))
        found.append(row)
    write_csv(target / FRAMES_FILE, found)


def write_bounds(target: Path, low: float, high: float) -> None:
    """Says in a prepared folder between which temperatures in °C its images lie."""
    bounds = {"absolute_min_temperature": low, "absolute_max_temperature": high}
    write_atomically(target / BOUNDS_FILE, json.dumps(bounds, indent=1) + "\n")
    (target / BOUNDS_TABLE).unlink(missing_ok=True)  # of an earlier preparation


def span_of(frame: ThermalFrame) -> tuple[float, float]:
    """The surface temperatures in °C of black and white of a frame with a span of its own, under its conditions."""
    white = round(frame.span.span_k / frame.calibration.scale)
    low, high = surface_celsius(np.array([0.0, white]), frame.calibration, frame.conditions)
    return float(low), float(high)


def write_spans(target: Path, spans: Mapping[str, tuple[float, float]]) -> None:
    """Says in a prepared folder between which temperatures in °C the camera drew each image, by its name: those at an end may be
    beyond."""
    write_csv(target / BOUNDS_TABLE, [{NAMES[0]: name, LOWER: low, UPPER: high} for name, (low, high) in spans.items()])
    (target / BOUNDS_FILE).unlink(missing_ok=True)  # of an earlier preparation


def uncertainty_at(
    celsius: float, calibration: Calibration, conditions: Conditions, standard: Mapping[str, float]
) -> dict[str, float]:
    """Standard uncertainties in K at a surface temperature (``radiometry.uncertainty``)."""
    surface = torch.tensor([celsius + KELVIN_AT_0_C], dtype=torch.float64)
    signal = measured_signal(surface, calibration.response, conditions)
    return {name: float(x) for name, x in uncertainty(signal, calibration.response, conditions, standard).items()}


def calibration_as_json(calibration: Calibration) -> dict[str, Any]:
    """What the numbers of a file mean, as JSON."""
    if calibration.scale is None and isinstance(calibration.response, PlanckResponse):
        return {"kind": "planck", **asdict(calibration.response)}
    band = calibration.response.band
    return {
        "kind": "linear",
        "scale": calibration.scale,
        "offset_c": calibration.offset_c,
        "band_um": [band.shortest_um, band.longest_um],
    }


def rows(frames: Sequence[ThermalFrame], records: Sequence[Mapping[str, Any]]) -> list[dict[str, Any]]:
    """A row for each frame: file, time, place, temperatures."""
    timed = all(frame.time is not None for frame in frames)
    first = instant(frames[0].time) if timed else 0.0
    found = []
    for frame, record in zip(frames, records, strict=True):
        quantiles = record["quantiles"] or [None] * len(QUANTILES)
        row = {"file": record["file"]} | ({"time_s": instant(frame.time) - first} if timed else {})
        row |= {"time": record["time"], **(record["position"] or {}), **(record["attitude"] or {})}
        found.append(row | {"least": quantiles[0], "median": quantiles[len(quantiles) // 2], "most": quantiles[-1]})
    return found
