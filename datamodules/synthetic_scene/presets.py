"""The scenes themselves: what stands where, of which material, how warm it starts and what heats it.

A new scene is one more entry in ``PRESETS``; a new object is one more ``Surface``. Lengths are metres, z is up, cameras
look towards +y.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from functools import cache

import torch
from torch import Tensor

from heatsplat.datamodules.synthetic_scene.carried import Carried
from heatsplat.datamodules.synthetic_scene.flaws import CameraFlaws, Gloss, Haze
from heatsplat.datamodules.synthetic_scene.heat import Material, Waveform, periodic
from heatsplat.datamodules.synthetic_scene.moving import Bolometers
from heatsplat.datamodules.synthetic_scene.shapes import Box, Cylinder, Plane, Point, Shape, Sphere

# Directions (cycles per wavelength) and phases of the smooth part of every pattern: three waves that share no axis.
_WAVES = ((0.83, 0.31, 0.46), (-0.37, 0.78, 0.51), (0.29, -0.55, 0.78))
_PHASES = (0.4, 2.1, 4.4)


@cache  # small tensors take as long to make as to compute with
def _waves(dtype: torch.dtype) -> tuple[Tensor, Tensor]:
    return torch.tensor(_WAVES, dtype=dtype), torch.tensor(_PHASES, dtype=dtype)


def _sum(values: Tensor) -> Tensor:
    """Sums [n] of rows [n, 3]; several times faster than a sum over a short axis."""
    return values[:, 0] + values[:, 1] + values[:, 2]


@dataclass(frozen=True)
class Pattern:
    """A quantity that varies over a surface: level + swing · (smooth waves in [-1, 1]) ± step (a 3D chessboard).

    **Convention:** points are given in the shape's own axes; the middle of a tile lies at the shape's origin, so that a
    plane or a cap through it is no border between tiles.

    Args:
        level: mean value.
        swing: largest deviation of the smooth part.
        wavelength_m: its wavelength.
        step: half the jump across the border of two tiles; 0 for none.
        tile_m: edge of a tile.
    """

    level: float
    swing: float = 0.0
    wavelength_m: float = 1.0
    step: float = 0.0
    tile_m: float = 0.4

    def __call__(self, points: Tensor) -> Tensor:
        """Values [n] at ``points`` [n, 3]."""
        value = torch.full_like(points[:, 0], self.level)
        if self.swing:
            value += _sum(self.waves(points))
        if self.step:
            tile = _sum((points / self.tile_m + 0.5).floor())
            value += self.step * (1.0 - 2.0 * torch.remainder(tile, 2.0))
        return value

    def waves(self, points: Tensor) -> Tensor:
        """The parts [n, 3] of the smooth part at ``points`` [n, 3], each a plane wave."""
        waves, starts = _waves(points.dtype)
        phases = points @ waves.T * (2.0 * math.pi / self.wavelength_m) + starts
        return self.swing / len(_WAVES) * torch.sin(phases)

    def wave_numbers(self, normals: Tensor) -> Tensor:
        """Wave numbers [n, 3] of ``waves`` along surfaces with unit ``normals`` [n, 3] (the shape's own axes), in 1/m."""
        waves = normals.new_tensor(_WAVES) * (2.0 * math.pi / self.wavelength_m)
        across = normals @ waves.T
        return (waves.square().sum(1) - across**2).clamp_min(0.0).sqrt()


@dataclass(frozen=True)
class Surface:
    """One object of a scene.

    Args:
        name: unique within the scene.
        shape: its geometry.
        material: what it is made of.
        absorbs: absorbed share of the lamp's flux over the surface, in [0, 1]; dark paint in the colour image too.
        color: its colour where it absorbs nothing, in [0, 1].
        transmits: share of visible light that passes straight through, in [0, 1]; heat does not.
        emissivity: ε in the thermal band, in (0, 1]; below 1 the surface mirrors the rest (``Scene.apparent``).
    """

    name: str
    shape: Shape
    material: Material
    absorbs: Pattern = Pattern(0.6)
    color: Point = (0.8, 0.8, 0.8)
    transmits: float = 0.0
    emissivity: float = 1.0


@dataclass(frozen=True)
class Lamp:
    """A driven source of heat: a spot light with a soft edge that casts shadows.

    Args:
        position, aim: where it is and the point it looks at.
        half_angle_deg: half its beam, at half its flux.
        flux_w_m2: flux at ``aim`` on a surface that faces the lamp.
        waveform: its level over time; it must end at the end of the record.
    """

    position: Point
    aim: Point
    half_angle_deg: float
    flux_w_m2: float
    waveform: Waveform


@dataclass(frozen=True)
class Preset:
    """A scene.

    Args:
        start_k: excess over ambient at time 0 by name of surface, throughout its depth; without a name at ambient.
        lamp: what heats the scene, or None.
        held: True where every point is supplied with the heat that it loses, so that nothing changes.
        surfaces: its objects.
        ambient_c: temperature of the surroundings in °C.
        duration_s: length of the record in seconds.
        haze: what dims the path of the heat, or None for clear air.
        flaws: what is wrong with the thermal camera, or None for nothing but noise.
        gloss: what its surfaces are besides black bodies, or None.
        diffusivity: of heat along the surfaces, in m²/s; exact on flat ones, as if they had no end. 0 for none.
        video_hz: frames per second of a camera that is swung; None for single frames all through the record.
        carried: a hot ball that is carried through the scene, or None.
        bounds_c: temperatures of black and white in the camera's images; None for those that its frames need.
        effects: names of the effects that it shows (``heatsplat.effects.catalogue``), which is what ought to be found.
        sparseness: by what factor its sparse model has fewer points than that of other presets.
        point_noise_m: how far a sparse point lies off its surface, standard deviation of each coordinate.
        bare: names of surfaces with too little texture for structure from motion to find a point on.
        approach_m: how far the camera comes nearer and goes away, from the middle of its path.
    """

    start_k: Mapping[str, Pattern] = field(default_factory=dict)
    lamp: Lamp | None = None
    held: bool = False
    surfaces: tuple[Surface, ...] = ()
    ambient_c: float = 22.0
    duration_s: float = 1800.0
    haze: Haze | None = None
    flaws: CameraFlaws | None = None
    sparseness: float = 1.0
    point_noise_m: float = 0.003
    bare: frozenset[str] = frozenset()
    approach_m: float = 0.15
    gloss: Gloss | None = None
    diffusivity: float = 0.0
    video_hz: float | None = None
    carried: Carried | None = None
    bounds_c: tuple[float, float] | None = None
    effects: frozenset[str] = frozenset()

    def __post_init__(self) -> None:
        names = [surface.name for surface in self.surfaces]
        if len(set(names)) != len(names):
            raise ValueError(f"preset has two surfaces of one name: {sorted(names)}")
        if unknown := set(self.start_k) - set(names):
            raise ValueError(f"preset starts surfaces that it does not have: {sorted(unknown)}; it has {sorted(names)}")
        if unknown := self.bare - set(names):
            raise ValueError(f"preset has no points on surfaces that it does not have: {sorted(unknown)}")
        if self.flaws and self.flaws.detector and self.video_hz is None:
            raise ValueError("a detector that lags or is read row by row needs a camera that is swung: give video_hz")
        if self.held and self.lamp is not None:
            raise ValueError("a preset is either held steady or heated by a lamp, not both")
        if self.carried is not None and (self.held or self.lamp is not None or self.diffusivity):
            raise ValueError(
                "a preset with a carried source has no other: neither a lamp, nor held or conducting surfaces"
            )


# Exchange coefficients are those of a room with moving air, radiation included. Depths are chosen so that the time
# constants ρc·depth/h span 4 minutes (plastic) to an hour (floor) and the Biot numbers h·depth/k 0.001 (aluminium, a
# single exponential) to 2 (wood, far from one).
WOOD = Material(conductivity=0.16, heat_capacity=0.9e6, depth_m=0.010, exchange=13.0)
ALUMINIUM = Material(conductivity=200.0, heat_capacity=2.4e6, depth_m=0.004, exchange=13.0)
STEEL = Material(conductivity=45.0, heat_capacity=3.7e6, depth_m=0.004, exchange=13.0)
CERAMIC = Material(conductivity=1.5, heat_capacity=2.0e6, depth_m=0.012, exchange=13.0)
RUBBER = Material(conductivity=0.25, heat_capacity=1.6e6, depth_m=0.008, exchange=13.0)
PLASTIC = Material(conductivity=0.3, heat_capacity=1.6e6, depth_m=0.003, exchange=13.0)
PLASTER = Material(conductivity=0.4, heat_capacity=1.0e6, depth_m=0.0095, exchange=10.0)
LINOLEUM = Material(conductivity=0.2, heat_capacity=1.4e6, depth_m=0.006, exchange=10.0)
GLASS = Material(conductivity=1.0, heat_capacity=2.1e6, depth_m=0.006, exchange=13.0)

TABLE_TOP = (
    Surface("floor", Plane((0, 0, 0), (0, 0, 1)), LINOLEUM, Pattern(0.55, 0.1, 1.1, 0.15, 0.45), (0.75, 0.72, 0.68)),
    Surface("wall", Plane((0, 1.0, 0), (0, -1, 0)), PLASTER, Pattern(0.5, 0.1, 1.2, 0.12, 0.5), (0.9, 0.88, 0.82)),
    Surface("left_wall", Plane((-1.7, 0, 0), (1, 0, 0)), PLASTER, Pattern(0.5, 0.15, 1.2), (0.82, 0.88, 0.9)),
    Surface("right_wall", Plane((1.7, 0, 0), (-1, 0, 0)), PLASTER, Pattern(0.5, 0.15, 1.2), (0.82, 0.88, 0.9)),
    Surface(
        "crate",
        Box((-0.45, 0.25, 0.25), (0.5, 0.4, 0.5), 20.0),
        WOOD,
        Pattern(0.45, 0.1, 0.6, 0.15, 0.25),
        (0.85, 0.6, 0.35),
    ),
    Surface(
        "tower",
        Box((0.5, 0.35, 0.35), (0.35, 0.35, 0.7), -25.0),
        ALUMINIUM,
        Pattern(0.5, 0.1, 0.5, 0.2, 0.175),
        (0.8, 0.82, 0.85),
    ),
    Surface("carton", Box((-0.45, 0.25, 0.59), (0.24, 0.22, 0.18), 55.0), PLASTIC, Pattern(0.4, 0.1), (0.9, 0.3, 0.3)),
    Surface("vase", Sphere((0.05, -0.15, 0.22), 0.22), CERAMIC, Pattern(0.6, 0.1, 0.4, 0.2, 0.17), (0.4, 0.6, 0.9)),
    Surface("ball", Sphere((-0.5, -0.4, 0.15), 0.15), RUBBER, Pattern(0.55, 0.2, 0.3), (0.5, 0.85, 0.5)),
    Surface("can", Cylinder((0.5, -0.35, 0.0), 0.14, 0.42), STEEL, Pattern(0.6, 0.0, 1.0, 0.2, 0.14), (0.9, 0.8, 0.3)),
)

# Window glass passes nine tenths of visible light and reflects most of the rest; in the thermal band it is a wall.
PANE = Surface(
    "pane", Box((0.05, -0.65, 0.37), (1.1, 0.012, 0.74)), GLASS, Pattern(0.0), (0.8, 0.9, 0.92), transmits=0.9
)

# Warm out of the oven, each at its own temperature: 22 °C surroundings, up to about 62 °C.
_WARM = {
    "floor": Pattern(8.0, 6.0, 1.1, 1.0, 0.45),
    "wall": Pattern(11.0, 7.0, 1.0, 1.5, 0.5),
    "left_wall": Pattern(9.0, 6.0, 1.3),
    "right_wall": Pattern(13.0, 6.0, 1.3),
    "crate": Pattern(27.0, 7.0, 0.6, 3.0, 0.25),
    "tower": Pattern(33.0, 5.0, 0.5, 2.5, 0.175),
    "carton": Pattern(36.0, 4.0, 0.3),
    "vase": Pattern(30.0, 6.0, 0.4, 3.0, 0.17),
    "ball": Pattern(22.0, 8.0, 0.3),
    "can": Pattern(19.0, 4.0, 0.5, 3.0, 0.14),
}

# The room of the heated scene has not quite settled when the record starts.
_LUKEWARM = {
    "floor": Pattern(2.5, 2.0, 0.8),
    "wall": Pattern(3.0, 2.5, 1.0),
    "left_wall": Pattern(3.0, 2.0, 1.3),
    "right_wall": Pattern(3.0, 2.0, 1.3),
    "crate": Pattern(4.0, 2.0, 0.5),
    "tower": Pattern(1.5, 1.0, 0.5),
    "carton": Pattern(6.0, 1.0, 0.3),
    "vase": Pattern(5.0, 2.0, 0.4),
    "ball": Pattern(2.0, 1.0, 0.3),
    "can": Pattern(6.0, 1.5, 0.5),
}

_LAMP = Lamp(
    position=(-0.6, -2.0, 2.0),
    aim=(0.0, 0.1, 0.25),
    half_angle_deg=36.0,
    flux_w_m2=1000.0,
    waveform=periodic(period_s=600.0, on_s=300.0, ramp_s=120.0, duration_s=1800.0),
)

# Before the ball, between vase and can, over the vase, and down again between vase and ball; it touches nothing.
_WAY = (
    (-0.95, -0.6, 0.2),
    (-0.2, -0.75, 0.12),
    (0.29, -0.6, 0.15),
    (0.32, 0.0, 0.45),
    (-0.2, 0.0, 0.48),
    (-0.26, -0.45, 0.2),
)

# Thin copper sheets: a pattern on them levels out before the sheet is cold.
_SHEETS = tuple(
    Surface(one.name, one.shape, Material(390.0, 3.4e6, 0.003, 11.0), one.absorbs, one.color) for one in TABLE_TOP[:6]
)
_SMOOTH = {one.name: Pattern(24.0 + i, 9.0, 0.8 + 0.1 * i) for i, one in enumerate(_SHEETS)}

# Few features: smooth walls and objects, on the objects' tiles of which alone structure from motion finds anything.
_SMOOTH_WALLS = {name: replace(_WARM[name], step=0.0) for name in ("floor", "wall", "left_wall", "right_wall")}

# Textures finer than the pixels of images of low resolution: tiles of 6 to 10 cm, where a pixel of the demo size at a
# quarter of its resolution is 5 cm wide.
_TILED = {
    name: replace(_WARM[name], step=3.0, tile_m=tile)
    for name, tile in {"floor": 0.1, "wall": 0.09, "crate": 0.07, "tower": 0.06, "vase": 0.06, "can": 0.06}.items()
}

# Metals that show other things than themselves, a pane that mirrors a little, and a radiator on the floor before them, below
# what the camera sees directly. Emissivities as in tables of thermographers: glass 0.85, oxidised steel 0.6, rough
# aluminium 0.3, polished tin 0.1.
_EMISSIVITIES = {"tower": 0.3, "can": 0.6, "carton": 0.1}
_BODIES = (
    *(replace(one, emissivity=_EMISSIVITIES.get(one.name, 1.0)) for one in TABLE_TOP),
    replace(PANE, shape=Box((-0.4, -0.75, 0.3), (0.6, 0.012, 0.6)), emissivity=0.85),
    Surface("radiator", Box((0.1, -1.55, 0.15), (1.4, 0.3, 0.3)), STEEL, Pattern(0.3), (0.95, 0.95, 0.95)),
)


def droplets(grams_per_m3: float) -> float:
    """Extinction in 1/m of a fog that holds so much liquid water.

    In the middle of the long-wave window, at 11 µm, the efficiency of droplets grows as 0.3 times their size parameter
    whatever their sizes (Chýlek 1978, J. Atmos. Sci. 35, 296), which gives 3π · 0.3 / (2 · 11 µm) per density of water.
    """
    return 3.0 * math.pi * 0.3 / (2.0 * 11e-6 * 1e6) * grams_per_m3


def _stations(corners: tuple[Point, ...], count: int) -> tuple[Point, ...]:
    """So many points at equal distances along straight lines between corners."""
    ends = torch.tensor(corners, dtype=torch.float64)
    lengths = torch.nn.functional.pad(ends.diff(dim=0).norm(dim=1).cumsum(0), (1, 0))
    stations = []
    for along in torch.linspace(0.0, float(lengths[-1]), count, dtype=torch.float64):
        leg = int(torch.searchsorted(lengths, along).clamp(1, len(corners) - 1))
        share = (along - lengths[leg - 1]) / (lengths[leg] - lengths[leg - 1])
        stations.append(tuple(torch.lerp(ends[leg - 1], ends[leg], share).tolist()))
    return tuple(stations)


# A camera without any flaw, to which presets add theirs.
_GOOD = CameraFlaws(gain=0.0, bias=0.0, falloff=(0.0, 0.0))
_DRIFTING = replace(_GOOD, drift=0.008)
_UNEVEN = CameraFlaws(falloff=(0.0, 0.0))
_DARK_CORNERS = replace(_GOOD, falloff=(-0.12, -0.08))


def _shows(*names: str) -> frozenset[str]:
    return frozenset(names)


PRESETS: dict[str, Preset] = {
    "static": Preset(start_k=_WARM, held=True, surfaces=TABLE_TOP),
    "cooling": Preset(start_k=_WARM, surfaces=TABLE_TOP, effects=_shows("relaxation")),
    "heated": Preset(
        start_k=_LUKEWARM, lamp=_LAMP, surfaces=TABLE_TOP, effects=_shows("relaxation", "harmonic_source")
    ),
    "glass": Preset(
        start_k=_WARM | {"pane": Pattern(4.0, 2.0, 0.5)},
        held=True,
        surfaces=(*TABLE_TOP, PANE),
        effects=_shows("thermal_opacity"),
    ),
    "noisy_sensor": Preset(
        start_k=_WARM,
        held=True,
        surfaces=TABLE_TOP,
        flaws=CameraFlaws(step=0.02),
        effects=_shows("fixed_pattern", "vignetting", "agc"),
    ),
    "haze": Preset(
        start_k=_WARM,
        held=True,
        surfaces=TABLE_TOP,
        haze=Haze(0.25, 0.9, 2.3),
        sparseness=8.0,
        effects=_shows("attenuation"),
    ),
    "drifting": Preset(start_k=_WARM, held=True, surfaces=TABLE_TOP, flaws=_DRIFTING, effects=_shows("frame_offset")),
    "drifting_cooling": Preset(
        start_k=_WARM, surfaces=TABLE_TOP, flaws=_DRIFTING, effects=_shows("frame_offset", "relaxation")
    ),
    "uneven": Preset(start_k=_WARM, held=True, surfaces=TABLE_TOP, flaws=_UNEVEN, effects=_shows("fixed_pattern")),
    "dark_corners": Preset(
        start_k=_WARM, held=True, surfaces=TABLE_TOP, flaws=_DARK_CORNERS, effects=_shows("vignetting")
    ),
    "uneven_heated": Preset(
        start_k=_LUKEWARM,
        lamp=_LAMP,
        surfaces=TABLE_TOP,
        flaws=CameraFlaws(),
        effects=_shows("relaxation", "harmonic_source", "fixed_pattern", "vignetting"),
    ),
    "blurred": Preset(
        start_k=_WARM, held=True, surfaces=TABLE_TOP, flaws=replace(_GOOD, blur_px=1.2), effects=_shows("point_spread")
    ),
    "blurred_cooling": Preset(
        start_k=_WARM,
        surfaces=TABLE_TOP,
        flaws=replace(_DARK_CORNERS, blur_px=1.2),
        effects=_shows("point_spread", "vignetting", "relaxation"),
    ),
    "bent_tone": Preset(
        start_k=_WARM,
        held=True,
        surfaces=TABLE_TOP,
        flaws=replace(_GOOD, drift=0.02, bend=0.25),
        effects=_shows("frame_offset", "tone"),
    ),
    "swung": Preset(start_k=_WARM, held=True, surfaces=TABLE_TOP, video_hz=30.0),
    "moving_camera": Preset(
        start_k=_WARM,
        held=True,
        surfaces=TABLE_TOP,
        video_hz=30.0,
        flaws=replace(_GOOD, detector=Bolometers(tau_s=0.012, readout_s=0.020)),
        effects=_shows("thermal_lag", "rolling_readout"),
    ),
    "mirrors": Preset(
        start_k=_WARM,
        held=True,
        surfaces=TABLE_TOP,
        gloss=Gloss(mirrors=0.15, warm_k=60.0, towards=(0.5, -0.6, 0.6)),
        effects=_shows("reflection"),
    ),
    "dull": Preset(
        start_k=_WARM, held=True, surfaces=TABLE_TOP, gloss=Gloss(fade=0.4), effects=_shows("directional_emissivity")
    ),
    "weak_texture": Preset(
        start_k=_WARM | _SMOOTH_WALLS,
        held=True,
        surfaces=TABLE_TOP,
        sparseness=20.0,
        point_noise_m=0.05,
        bare=frozenset(_SMOOTH_WALLS),
    ),
    "soft_edges": Preset(
        start_k=_WARM,
        held=True,
        surfaces=TABLE_TOP,
        haze=Haze(droplets(2.0)),
        flaws=replace(_GOOD, blur_px=1.2),
        effects=_shows("attenuation", "point_spread"),
    ),
    "fog": Preset(
        start_k=_WARM,
        held=True,
        surfaces=TABLE_TOP,
        haze=Haze(droplets(2.0)),
        approach_m=0.6,
        effects=_shows("attenuation"),
    ),
    "fading": Preset(
        start_k=_WARM,
        held=True,
        surfaces=TABLE_TOP,
        flaws=replace(_GOOD, gain_drift=0.02, frames_per_step=1000),
        effects=_shows("agc"),
    ),
    "metals": Preset(
        start_k=_WARM | {"pane": Pattern(4.0, 2.0, 0.5), "radiator": Pattern(40.0)},
        held=True,
        surfaces=_BODIES,
        effects=_shows("reflection", "thermal_opacity"),
    ),
    "fine_texture": Preset(start_k=_WARM | _TILED, held=True, surfaces=TABLE_TOP),
    "auto_gain": Preset(
        start_k=_WARM,
        held=True,
        surfaces=TABLE_TOP,
        flaws=CameraFlaws(stretch=0.3, shift=0.3),
        effects=_shows("agc", "fixed_pattern", "vignetting"),
    ),
    "moving_source": Preset(
        start_k=_LUKEWARM,
        surfaces=TABLE_TOP,
        duration_s=900.0,
        carried=Carried(_stations(_WAY, 25), radius_m=0.05, celsius=400.0),
        bounds_c=(18.0, 50.0),
        effects=_shows("relaxation"),
    ),
    # Copper as handbooks have it, to two digits; conductivity and heat capacity of its material alone would give 1.15e-4.
    "sheets": Preset(start_k=_SMOOTH, surfaces=_SHEETS, diffusivity=1.2e-4, effects=_shows("relaxation", "conduction")),
}
