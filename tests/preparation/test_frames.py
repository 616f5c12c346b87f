import math
from dataclasses import replace
from datetime import UTC, datetime, timedelta
from pathlib import Path

import cv2
import numpy as np
import pytest
from camera_files import dji_jpeg, raw_for, temperatures, with_segment
from PIL import Image
from recordings import START, STATED, read_frames, write_flir, write_images, write_sequence

from heatsplat.contracts import SceneError, ThermalRange, as_written
from heatsplat.datamodules.formats.palette import named
from heatsplat.preparation import frames
from heatsplat.preparation.fingerprint import fingerprint
from heatsplat.preparation.frames import Reading, read_recording
from heatsplat.preparation.meaning import Meaning

DATA = Path(__file__).parents[3] / "shared" / "data"
needs_data = pytest.mark.skipif(not DATA.is_dir(), reason="real recordings are not at ../shared/data")
FLOATS = temperatures().astype(np.float32)


def test_frames_of_flir_come_in_the_order_of_their_times_with_all_that_their_files_say(tmp_path):
    frames = read_frames(write_flir(tmp_path))
    assert [frame.time for frame in frames] == [START + timedelta(seconds=2 * i) for i in range(4)]
    assert [frame.name for frame in frames] == ["IR_0000", "IR_0003", "IR_0002", "IR_0001"]
    first = frames[0]
    assert first.conditions.emissivity == pytest.approx(STATED["emissivity"])
    assert first.position.latitude_deg == 51.0 and first.camera.model == "Test Cam 640"
    assert first.sources["humidity"] == "file"
    assert (first.temperature() > temperatures(0) + 0.1).any()  # the conditions of the file count


def test_frames_without_times_are_in_the_order_of_the_numbers_in_their_names(tmp_path):
    found = read_recording(write_images(tmp_path, {f"{name}.tiff": FLOATS for name in ("b 10", "b 2", "b 09", "a3")}))
    assert [frame.name for frame in found.frames] == ["a3", "b 2", "b 09", "b 10"]
    assert any("4 of 4 frames have no time" in note for note in found.notes)


def test_every_so_many_th_frame_of_each_camera_is_taken(tmp_path):
    small = FLOATS[:16, :20]
    names = {f"a{i}.tiff": FLOATS for i in range(7)} | {f"b{i}.tiff": small for i in range(3)}
    folder = write_images(tmp_path, names)
    found = read_recording(folder, Reading(every=3))
    assert [frame.name for frame in found.frames] == ["a0", "a3", "a6", "b0"]
    assert "every=3 takes 4 of 10 frames" in found.notes
    for wrong in (0, 1.5, True):
        with pytest.raises(SceneError, match=f"every must be a whole number, 1 or more, got {as_written(wrong)}"):
            Reading(every=wrong)


def test_hidden_files_are_no_frames(tmp_path):
    """macOS puts one beside each file that it copies to a card, and other programs keep thumbnails."""
    write_images(tmp_path, {"a1.tiff": FLOATS, "a2.tiff": FLOATS})
    for name in ("._a1.tiff", "._a2.jpg", "._table.csv", "._a.fff"):
        (tmp_path / name).write_bytes(b"\0\x05\x16\x07Mac OS X")
    write_images(tmp_path / ".thumbnails", {"a1.tiff": FLOATS})
    assert [frame.name for frame in read_frames(tmp_path)] == ["a1", "a2"]


def test_sequences_have_a_frame_each(tmp_path):
    frames = read_frames(write_sequence(tmp_path / "flight.seq").parent)
    assert [frame.name for frame in frames] == [f"flight_{i:06d}" for i in range(4)]
    np.testing.assert_array_equal(frames[2].load(), raw_for(temperatures(2)))


@pytest.mark.parametrize(
    ("image", "meaning", "expected"),
    [
        (FLOATS, Meaning(), FLOATS),
        (FLOATS + 273.15, Meaning(offset_c=-273.15), FLOATS),
        (((FLOATS + 273.15) * 100).astype(np.uint16), Meaning(), FLOATS),
        (((FLOATS + 273.15) * 64).astype(np.uint16), Meaning(scale=1 / 64), FLOATS),
        ((FLOATS * 5).astype(np.uint8), Meaning(bounds_c=[0.0, 51.0]), FLOATS),
    ],
    ids=["celsius", "kelvin", "kelvin x 100", "1/64 K", "greys"],
)
@pytest.mark.parametrize("ending", ["tiff", "png"])
def test_images_are_temperatures(tmp_path, image, meaning, expected, ending):
    if image.dtype == np.float32 and ending == "png":
        return
    write_images(tmp_path, {f"a.{ending}": image})
    (frame,) = read_frames(tmp_path, Reading(meaning))
    np.testing.assert_allclose(frame.temperature(), expected, atol=0.21 if image.dtype == np.uint8 else 0.02)


def test_photos_belong_to_the_frames_of_their_exposure(tmp_path):
    write_images(tmp_path, {"DJI_20240101120000_0007_T.tiff": FLOATS, "DJI_20240101120003_0008_T.tiff": FLOATS})
    photo = np.zeros((8, 8, 3), np.uint8)
    write_images(tmp_path / "rgb", {"DJI_20240101120001_0007_V.jpg": photo})
    first, second = read_frames(tmp_path)
    assert first.rgb == tmp_path / "rgb" / "DJI_20240101120001_0007_V.jpg" and second.rgb is None
    assert first.time == datetime(2024, 1, 1, 12)


def test_cards_count_from_one_in_every_folder(tmp_path):
    """A camera fills 100_FLIR and then 101_FLIR with files of the same names: tables and photos are told by folder."""
    files = [f"{card}_FLIR/FLIR000{i}" for card in (100, 101) for i in (0, 1)]
    for file in files:
        write_images(tmp_path / "a" / file.split("/")[0], {f"{file.split('/')[1]}.tiff": FLOATS})
    for file in files[:2]:
        write_images(tmp_path / "a" / "100_FLIR", {f"{file.split('/')[1]}.jpg": np.zeros((8, 8, 3), np.uint8)})
    table = tmp_path / "table.csv"
    rows = [f"{file}.tiff,2024-07-01T10:00:0{i}Z" for i, file in enumerate(files)]
    table.write_text("\n".join(["file,when", *rows]))
    reading = Reading(table=table, columns={"name": "file", "time": "when"})
    frames = read_frames(tmp_path / "a", reading)
    assert [(f.path.parent.name, f.path.stem, f.time.second) for f in frames] == [
        (*file.split("/"), i) for i, file in enumerate(files)
    ]
    assert [f.rgb is not None for f in frames] == [True, True, False, False]
    table.write_text("\n".join(["file,when", rows[0], rows[0].replace("00Z", "09Z")]))
    with pytest.raises(SceneError, match="line 3: 100_FLIR/FLIR0000.tiff has another row above; keep one"):
        read_frames(tmp_path / "a", reading)
    table.write_text("\n".join(["file,when", "x/FLIR0000,2024-07-01T10:00:00Z", "y/FLIR0000,2024-07-01T10:00:01Z"]))
    with pytest.raises(SceneError, match="x/FLIR0000 and y/FLIR0000 may both be .*FLIR0000.tiff; keep one of them"):
        read_frames(tmp_path / "a", reading)


def test_photos_of_other_sides_are_left_to_them(tmp_path):
    """_W and _S may stand for a modality or for a side of a house: the photo of the very name goes first."""
    sides = ("N", "S", "W")
    write_images(tmp_path, {f"facade_{side}.tiff": FLOATS for side in sides})
    write_images(tmp_path, {f"facade_{side}.jpg": np.zeros((8, 8, 3), np.uint8) for side in sides})
    assert all(frame.rgb.stem == frame.path.stem for frame in read_frames(tmp_path))


def test_what_is_said_of_numbers_and_changes_nothing_is_refused(tmp_path):
    write_flir(tmp_path / "flir", 1)
    with pytest.raises(
        SceneError, match="counts.scale changes nothing for radiometric files; .* counts.planck, or by the files"
    ):
        read_frames(tmp_path / "flir", Reading(Meaning(scale=0.01)))
    write_images(tmp_path / "counts", {"a.png": (100 * (FLOATS + 273.15)).astype(np.uint16)})
    with pytest.raises(SceneError, match="bounds_c changes nothing for 16-bit images"):
        read_frames(tmp_path / "counts", Reading(Meaning(bounds_c=[0, 50])))
    with pytest.raises(SceneError, match="counts.offset_c is the °C of count 0 and needs counts.scale"):
        read_frames(tmp_path / "counts", Reading(Meaning(offset_c=0.0)))


def test_a_zone_is_given_to_times_that_have_none(tmp_path):
    write_images(tmp_path, {"DJI_20240701120000_0007_T.tiff": FLOATS})
    (frame,) = read_frames(tmp_path, Reading(zone="Europe/Berlin"))
    assert frame.time.astimezone(UTC) == datetime(2024, 7, 1, 10, tzinfo=UTC)
    with pytest.raises(SceneError, match="zone=Mars is no time zone"):
        read_frames(tmp_path, Reading(zone="Mars"))


def test_times_of_which_only_some_state_a_zone_are_asked_about(tmp_path):
    """Such as where the zone is told by GPS, which some frames lack: two hours would lie between frames of one second."""
    for index, zone in enumerate(("+02:00", "", "+02:00")):
        _with_clock(tmp_path / f"f{index}.png", f"2024:07:01 12:00:0{index}", zone)
    with pytest.raises(SceneError, match=r"1 of 3 frames state no zone, such as f1.png .*, such as f0.png .* zone="):
        read_frames(tmp_path)
    frames = read_frames(tmp_path, Reading(zone="Europe/Berlin"))
    assert [frame.name for frame in frames] == ["f0", "f1", "f2"]
    assert {frame.time.utcoffset() for frame in frames} == {timedelta(hours=2)}
    _with_clock(tmp_path / "f3.png", "", "")  # without a time no frame has one that counts
    assert [frame.name for frame in read_frames(tmp_path)] == ["f0", "f1", "f2", "f3"]


def test_frames_of_one_second_are_in_the_order_of_the_numbers_in_their_names(tmp_path):
    for number, second in ((8, 1), (9, 1), (10, 1), (11, 0)):
        _with_clock(tmp_path / f"f{number}.png", f"2024:07:01 12:00:0{second}", "")
    assert [frame.name for frame in read_frames(tmp_path)] == ["f11", "f8", "f9", "f10"]


def test_a_fix_of_an_earlier_place_is_left_out(tmp_path):
    """It would be the origin of the world, hundreds of kilometres away and not level, and shift a map."""
    write_images(tmp_path / "files", {f"f{i}.tiff": FLOATS for i in range(8)})
    columns = {"name": "file", "latitude_deg": "lat", "longitude_deg": "lon"}
    reading = Reading(table=tmp_path / "table.csv", columns=columns)

    def placed(first: str) -> tuple[list[bool], str]:
        rows = [f"f0,{first}", *(f"f{i},{51 + 1e-4 * i},4" for i in range(1, 8))]
        reading.table.write_text("\n".join(["file,lat,lon", *rows]))
        found = read_recording(tmp_path / "files", reading)
        return [frame.position is not None for frame in found.frames], " ".join(found.notes)

    near, far = placed("51.008,4"), placed("48.1,11.5")
    assert near[0] == [True] * 8 and "GPS" not in near[1]  # 0.8 km
    assert (
        far[0] == [False] + [True] * 7 and "GPS of 1 frame, such as f0, lies 630 km from that of the others" in far[1]
    )


def _with_clock(path: Path, clock: str, zone: str) -> None:
    """Counts of kelvin x 100 whose EXIF has a time, unless it is empty."""
    exif = Image.Exif()
    exif[0x10F] = "Maker"
    exif.get_ifd(0x8769).update({tag: text for tag, text in ((0x9003, clock), (0x9011, zone)) if text})
    Image.fromarray((100 * (FLOATS + 273.15)).astype(np.uint16)).save(path, exif=exif)


def test_folders_that_cannot_be_understood_are_refused_by_name(tmp_path):
    with pytest.raises(SceneError, match="nothing is no folder"):
        read_frames(tmp_path / "nothing")
    with pytest.raises(SceneError, match="holds no thermal image"):
        read_frames(write_images(tmp_path / "empty", {}))
    for text, what in (("", "is empty, export it again"), ("a,b\n1,2\n", "is no table of pixels")):
        (tmp_path / "empty" / "b.csv").write_text(text)
        with pytest.raises(SceneError, match=f"None of its .csv has 16 rows of 16 numbers or more: b.csv {what}"):
            read_frames(tmp_path / "empty")
    y, x = np.mgrid[:16, :16].astype(np.uint8)
    palette = cv2.applyColorMap((y * 16 + x), cv2.COLORMAP_INFERNO)
    with pytest.raises(
        SceneError,
        match="coloured pictures alone .such as a.png.: colours .*palette=iron bounds_c.*Photos .*data.images=null data.rgb=",
    ):
        read_frames(write_images(tmp_path / "colours", {"a.png": palette}))
    with pytest.raises(SceneError, match="several kinds.*floating-point images .*16-bit images .*folder of its own"):
        read_frames(write_images(tmp_path / "mixed", {"a.tiff": FLOATS, "b.png": (FLOATS * 100).astype(np.uint16)}))
    with pytest.raises(SceneError, match="a.png and .*a.tif would both become"):
        both = {"a.png": (FLOATS * 5).astype(np.uint8), "a.tif": (FLOATS * 5).astype(np.uint8)}
        read_frames(write_images(tmp_path / "twice", both), Reading(Meaning(bounds_c=[0, 51])))
    (tmp_path / "broken").mkdir()
    (tmp_path / "broken" / "c.png").write_bytes(b"\x89PNG broken")
    with pytest.raises(SceneError, match=r"c\.png is corrupt"):
        read_frames(tmp_path / "broken")


def coloured(levels, name="iron"):
    """A picture of levels from 0 to 255, with the channels in OpenCV's order."""
    return np.rint(named(name).curve(256)[levels]).astype(np.uint8)[..., ::-1]


def test_pictures_in_false_colours_have_temperatures_by_palette_and_bounds(tmp_path):
    levels = (FLOATS * 5).astype(np.uint8)
    drawn = coloured(levels)
    drawn[:3, :5] = (0, 255, 0)
    bar = np.repeat(coloured(np.arange(256)[::-1, None]), 12, axis=1)
    write_images(tmp_path, {"a.png": coloured(levels), "b.png": drawn, "bar.png": bar})
    for palette, tolerance in (("iron", 0.21), ("bar.png", 0.5)):
        (tmp_path / "bar.png").unlink() if palette == "iron" else cv2.imwrite(str(tmp_path / "bar.png"), bar)
        a, b = read_frames(tmp_path, Reading(Meaning(bounds_c=[0.0, 51.0]), palette=palette))
        np.testing.assert_allclose(a.temperature(), levels / 5.0, atol=tolerance)
        assert np.isnan(b.temperature()[:3, :5]).all() and np.isfinite(b.temperature()[3:]).all()
        notes = read_recording(tmp_path, Reading(Meaning(bounds_c=[0.0, 51.0]), palette=palette)).notes
        assert any(note.startswith("levels by the palette") and palette in note for note in notes)
    one, other = (
        read_frames(tmp_path, Reading(Meaning(bounds_c=[0.0, 51.0]), palette=p))[0] for p in ("iron", "iron_r")
    )
    assert fingerprint(one) != fingerprint(other)


def test_palettes_that_do_not_fit_the_files_are_refused(tmp_path):
    levels = (FLOATS * 5).astype(np.uint8)
    bounds = Meaning(bounds_c=[0.0, 51.0])
    colours = write_images(tmp_path / "colours", {"a.png": coloured(levels)})
    with pytest.raises(
        SceneError, match=r"palette=iron tells levels from the colours of a.png .*: bounds_c=\[min,max\]"
    ):
        read_frames(colours, Reading(palette="iron"))
    with pytest.raises(SceneError, match=r"a.png is not in the colours of jet: .*\(palette=bar.png"):
        read_frames(colours, Reading(bounds, palette="jet"))[0].load()
    found = read_recording(
        write_images(tmp_path / "like", {"a.png": coloured(np.tile(np.arange(20, 236, dtype=np.uint8), (30, 1)))}),
        Reading(bounds, palette="inferno"),
    )
    assert any("the images fit the palette iron much better" in note for note in found.notes)
    with pytest.raises(SceneError, match="palette=irn is no palette .did you mean iron"):
        read_frames(colours, Reading(bounds, palette="irn"))
    with pytest.raises(SceneError, match="palette_hot=top is for the picture of a colour bar"):
        read_frames(colours, Reading(bounds, palette="iron", palette_hot="top"))
    with pytest.raises(SceneError, match="palette_hot=top says how a colour bar lies; give it as palette"):
        Reading(palette_hot="top")
    for name, pixels, what in (
        ("a.png", levels, "8-bit greys"),
        ("a.png", (FLOATS * 100 + 27315).astype(np.uint16), "16-bit images"),
        ("a.tiff", FLOATS, "floating-point images"),
    ):
        folder = write_images(tmp_path / what.replace(" ", "_"), {name: pixels, "b.png": coloured(levels)})
        with pytest.raises(
            SceneError, match=f"palette=iron is for pictures in false colours, and .* holds {what} .such as {name}"
        ):
            read_frames(folder, Reading(bounds, palette="iron"))


def test_pictures_of_dji_without_temperatures_are_refused_with_what_to_run_unless_bounds_are_given(tmp_path):
    counts = (np.arange(512 * 640).reshape(512, 640) % 3000 + 18000).astype(np.uint16)
    xmp = b'http://ns.adobe.com/xap/1.0/\0<x drone-dji:ImageSource="InfraredCamera"/>'
    grey = cv2.imencode(".jpg", cv2.merge([(FLOATS * 5).astype(np.uint8)] * 3))[1].tobytes()
    for name, data in (("counts", dji_jpeg(counts)), ("cut", with_segment(grey, 0xE1, xmp))):
        (tmp_path / name).mkdir()
        (tmp_path / name / "DJI_1_T.JPG").write_bytes(data)
        with pytest.raises(
            SceneError, match="DJI_1_T.JPG is a thermal picture of DJI .*dji_irp -s IMAGE.JPG -a measure .*bounds_c"
        ):
            read_frames(tmp_path / name)
    (frame,) = read_frames(tmp_path / "cut", Reading(Meaning(bounds_c=[0.0, 51.0])))
    np.testing.assert_allclose(frame.temperature(), FLOATS, atol=0.6)  # of a JPEG


def test_a_file_that_may_not_be_read_is_not_called_corrupt(tmp_path, monkeypatch):
    write_images(tmp_path, {"a.tiff": FLOATS})

    def refuses(path):
        raise PermissionError(13, "Permission denied", str(path))

    monkeypatch.setattr("heatsplat.preparation.frames.Image.open", refuses)
    with pytest.raises(SceneError, match=r"a\.tiff cannot be read: Permission denied"):
        read_frames(tmp_path)


def test_greys_that_were_stored_as_colours_are_greys(tmp_path):
    grey = (FLOATS * 5).astype(np.uint8)
    write_images(tmp_path, {"a.png": cv2.merge([grey, grey, grey])})
    (frame,) = read_frames(tmp_path, Reading(Meaning(bounds_c=[0.0, 51.0])))
    np.testing.assert_allclose(frame.temperature(), FLOATS, atol=0.21)


@pytest.mark.parametrize(("ending", "channels"), [("png", 3), ("png", 4), ("tiff", 3)])
def test_counts_that_were_stored_as_colours_are_counts(tmp_path, ending, channels):
    """Of 16 bits: as greys of 8 bits 300 K would be 5,800 °C between bounds of 0 and 50, and no temperature without."""
    counts = (100 * (FLOATS + 273.15)).astype(np.uint16)
    write_images(tmp_path, {f"a.{ending}": np.dstack([counts] * 3 + [np.full_like(counts, 65535)] * (channels - 3))})
    (frame,) = read_frames(tmp_path)
    np.testing.assert_array_equal(frame.load(), counts)
    np.testing.assert_allclose(frame.temperature(), FLOATS, atol=0.011)
    with pytest.raises(SceneError, match="bounds_c changes nothing for 16-bit images; .* said by counts.scale"):
        read_frames(tmp_path, Reading(Meaning(bounds_c=[0, 50])))


def test_floats_of_several_channels_are_refused(tmp_path):
    write_images(tmp_path, {"a.tiff": np.dstack([FLOATS] * 3)})
    with pytest.raises(SceneError, match="a.tiff has 3 channels of floats, and temperatures are one"):
        read_frames(tmp_path)


@needs_data
def test_real_files_give_the_temperatures_that_are_stated_for_them(tmp_path):
    """PROVENANCE: FLIR ONE about -10 .. 27 °C; M3T within 23.6 .. 52.9 °C; ThermoScenes' greys between their bounds."""
    from heatsplat.physics.radiometry import Conditions

    (tmp_path / "one.jpg").write_bytes((DATA / "flir" / "IMG_0620.JPG").read_bytes())
    (one,) = read_frames(tmp_path)
    apparent = replace(one, conditions=Conditions()).temperature()
    assert apparent.min() == pytest.approx(-10, abs=0.5) and apparent.max() == pytest.approx(27, abs=0.6)
    assert one.camera.model == "FLIR ONE Pro (gen 3)" and one.position.altitude_m == pytest.approx(394.29)
    flight = read_frames(DATA / "m3t_heath" / "raw_rjpeg")
    assert [frame.camera.model for frame in flight] == ["M3T", "M3T"]
    assert flight[0].attitude.pitch_deg == -89.9 and flight[0].position.above_takeoff_m == 75.002
    for frame in flight:
        apparent = replace(frame, conditions=Conditions()).temperature()
        assert apparent.min() >= 23.6 and apparent.max() <= 52.9
        assert frame.time.tzinfo is not None
    repeats = read_frames(DATA / "flir" / "static_repeats")
    assert len(repeats) == 24
    found = repeats[0].temperature()
    assert 18.9 <= found.min() < found.max() <= 33.17 and not math.isnan(found.mean())


def test_floats_of_64_bits_are_read_as_those_of_32(tmp_path):
    write_images(tmp_path / "wide", {"a.tiff": FLOATS.astype(np.float64)})
    write_images(tmp_path / "usual", {"a.tiff": FLOATS})
    wide, usual = (read_recording(tmp_path / name).frames[0] for name in ("wide", "usual"))
    assert wide.size == usual.size
    np.testing.assert_array_equal(wide.temperature(), usual.temperature())


def test_counters_that_restart_within_a_folder_do_not_mix_photos(tmp_path):
    clocks = ("20240806173449", "20240807101500")
    write_images(tmp_path, {f"DJI_{clock}_0008_T.tiff": FLOATS for clock in clocks})
    photo = np.zeros((8, 8, 3), np.uint8)
    write_images(tmp_path, {f"DJI_{clock}_0008_V.jpg": photo for clock in ("20240806173450", "20240807101501")})
    write_images(tmp_path, {"DJI_20240807101503_0008_V.jpg": photo})
    assert [frame.rgb.stem for frame in read_frames(tmp_path)] == [
        "DJI_20240806173450_0008_V",
        "DJI_20240807101501_0008_V",
    ]
    (tmp_path / "DJI_20240806173450_0008_V.jpg").unlink()
    assert [frame.rgb is not None for frame in read_frames(tmp_path)] == [False, True]


@pytest.mark.parametrize("kind", ["float", "grey"])
def test_every_image_of_a_tiff_is_a_frame(tmp_path, monkeypatch, kind):
    monkeypatch.delattr(frames, "read_bytes")  # a recording may be larger than memory
    stack = np.stack([FLOATS + i for i in range(4)])
    stack = stack if kind == "float" else (5 * stack).astype(np.uint8)
    assert cv2.imwritemulti(str(tmp_path / "rec.tiff"), list(stack))
    reading = Reading(Meaning(bounds_c=[0.0, 51.0]) if kind == "grey" else Meaning())
    found = read_recording(tmp_path, reading)
    assert [frame.name for frame in found.frames] == [f"rec_{i:06d}" for i in range(4)]
    for frame, image in zip(found.frames, stack, strict=True):
        np.testing.assert_array_equal(frame.load(), image)
    assert "rec.tiff: 4 images in one file, each is a frame" in found.notes
    table = tmp_path / "table.csv"
    table.write_text("\n".join(["file,when", *(f"rec_{i:06d},2024-07-01T10:00:0{9 - i}Z" for i in range(4))]))
    timed = replace(reading, table=table, columns={"name": "file", "time": "when"})
    assert [frame.number for frame in read_frames(tmp_path, timed)] == [3, 2, 1, 0]
    table.write_text("file,when\nrec.tiff,2024-07-01T10:00:00Z\n")
    with pytest.raises(SceneError, match="line 2: rec.tiff holds 4 frames, .* give each a row, as rec_000000"):
        read_frames(tmp_path, timed)


def test_exported_tables_are_frames_and_other_tables_are_none(tmp_path, monkeypatch):
    rows = np.round(np.linspace(15, 40, 18 * 20), 2).reshape(18, 20)
    for name, shift in (("IR_0001", 0), ("IR_0002", 1)):
        text = "\n".join(";".join(f"{value + shift:.2f}".replace(".", ",") for value in row) for row in rows)
        (tmp_path / f"{name}.csv").write_text("Emissivity;0,95\n" + text)
    (tmp_path / "weather.csv").write_text("time,air_c\n0,12\n")
    read, reader = [], frames.read_temperature_table
    monkeypatch.setattr(frames, "read_temperature_table", lambda path: read.append(path.stem) or reader(path))
    first, second = read_frames(tmp_path)
    assert sorted(read) == ["IR_0001", "IR_0001", "IR_0002", "weather"], "once each, and the first for its meaning"
    assert (first.name, first.size, first.time) == ("IR_0001", (20, 18), None)
    np.testing.assert_allclose(first.temperature(), rows, atol=1e-5)
    np.testing.assert_allclose(second.temperature(), rows + 1, atol=1e-5)


def previews(colour_map, size=1):
    """A table of temperatures in two frames, and pictures of them by a colour map, or in greys for None."""
    y, x = np.mgrid[:18, :20]
    for frame, shift in (("IR_0001", 0.0), ("IR_0002", 4.0)):
        values = 20 + 8 * np.sin(0.4 * x + shift) + 6 * np.cos(0.3 * y)
        grey = np.clip((values - 6) / 28 * 255, 0, 255).astype(np.uint8).repeat(size, 0).repeat(size, 1)
        picture = np.stack([grey] * 3, 2) if colour_map is None else cv2.applyColorMap(grey, colour_map)[..., ::-1]
        yield frame, values.astype(np.float32), picture


@pytest.mark.parametrize(("colour_map", "size"), [(cv2.COLORMAP_INFERNO, 1), (cv2.COLORMAP_JET, 4), (None, 1)])
def test_pictures_of_the_temperatures_are_no_photos(tmp_path, colour_map, size):
    for name, values, picture in previews(colour_map, size):
        (tmp_path / f"{name}.csv").write_text("\n".join(";".join(f"{value:.3f}" for value in row) for row in values))
        write_images(tmp_path, {f"{name}.png": picture})
    found = read_recording(tmp_path)
    assert [frame.rgb for frame in found.frames] == [None, None]
    assert "2 pictures such as IR_0001.png show the temperatures themselves in greys or colours" in " ".join(
        found.notes
    )
    photo = np.random.default_rng(0).integers(0, 255, (36, 40, 3), np.uint8)
    write_images(tmp_path, {f"IR_000{i}_V.jpg": photo for i in (1, 2)})
    assert [frame.rgb.name for frame in read_frames(tmp_path)] == ["IR_0001_V.jpg", "IR_0002_V.jpg"]


def test_photos_that_temperatures_explain_in_part_are_photos(tmp_path):
    for name, values, picture in previews(cv2.COLORMAP_INFERNO):
        picture = picture.copy()
        picture[:, 12:] = np.random.default_rng(0).integers(0, 255, (18, 8, 3), np.uint8)
        write_images(tmp_path, {f"{name}.tiff": values, f"{name}.png": picture})
    assert [frame.rgb.name for frame in read_frames(tmp_path)] == ["IR_0001.png", "IR_0002.png"]


# A span of its own for every image ----------------------------------------------------------------------------------

SPAN_COLUMNS = {"name": "file", "time": "time", "min_c": "min_c", "max_c": "max_c"}


def truth(index):
    """°C [H, W] of a frame: a slope, and a spot that is warmer in every frame."""
    y, x = np.mgrid[:24, :32]
    return 10.0 + 0.3 * x + 0.2 * y + (4.0 + 3.0 * index) * np.exp(-((x - 8 - 4 * index) ** 2 + (y - 10) ** 2) / 20.0)


def greys(index, ends, dtype=np.uint8):
    full = np.iinfo(dtype).max
    return np.rint(np.clip((truth(index) - ends[0]) / (ends[1] - ends[0]), 0, 1) * full).astype(dtype)


def spans_of_five(cut=0.0):
    """Ends that an automatic range takes, to a tenth of a degree."""
    return [tuple(np.quantile(truth(i), [cut, 1 - cut]).round(1)) for i in range(5)]


def write_table(folder, spans, names=None, head="file,min_c,max_c"):
    names = names or [f"f{i}" for i in range(len(spans))]
    rows = [f"{name},{low},{high}" for name, (low, high) in zip(names, spans, strict=True)]
    path = folder / "spans.csv"
    path.write_text("\n".join([head, *rows]))
    return path


@pytest.mark.parametrize("kind", ["grey", "grey16", "colour"])
def test_images_of_a_span_each_are_the_truth_to_half_a_step(tmp_path, kind):
    spans, dtype = spans_of_five(), np.uint16 if kind == "grey16" else np.uint8
    drawn = {f"f{i}.png": greys(i, ends, dtype) for i, ends in enumerate(spans)}
    palette = "iron" if kind == "colour" else None
    if palette:
        drawn = {name: coloured(levels) for name, levels in drawn.items()}
    source = write_images(tmp_path / "files", drawn)
    reading = Reading(table=write_table(tmp_path, spans), columns=SPAN_COLUMNS, palette=palette)
    found = read_recording(source, reading)
    full, lows, highs = np.iinfo(dtype).max, *zip(*spans, strict=True)
    for i, frame in enumerate(found.frames):
        (low, high), celsius = spans[i], frame.temperature()
        half = (1.5 if palette else 0.5) * (high - low) / full + 1e-5
        within = (truth(i) >= low) & (truth(i) <= high)
        assert within.mean() > 0.95 and np.abs(celsius - truth(i))[within].max() <= half
        assert frame.span == ThermalRange(low, high)
    assert any(
        f"greys of {min(lows):g} .. {max(highs):g} °C by spans.csv: each image has" in note for note in found.notes
    )
    assert any("spans.csv tells max_c, min_c of 5 of 5 frames" in note for note in found.notes)


def test_tables_of_spans_that_do_not_fit_are_refused(tmp_path):
    spans = spans_of_five()
    source = write_images(tmp_path / "files", {f"f{i}.png": greys(i, ends) for i, ends in enumerate(spans)})

    def refused(message, written=spans, names=None, head="file,min_c,max_c", **more):
        reading = Reading(table=write_table(tmp_path, written, names, head), columns=SPAN_COLUMNS, **more)
        with pytest.raises(SceneError, match=message):
            read_recording(source, reading)

    refused(r"no min_c and max_c of 1 frame of 5, such as f4.png: add them, or take these files out", spans[:4])
    refused(r"no min_c and max_c of 1 frame of 5, such as f2.png", [*spans[:2], ("", ""), *spans[3:]])
    refused(
        r"spans.csv, line 4: the minimum 30.0 °C lies above the maximum 2.0 °C; swap", [*spans[:2], (30, 2), *spans[3:]]
    )
    refused(r"spans.csv, line 4: the maximum '' is no number", [*spans[:2], (30, ""), *spans[3:]])
    refused(r"has a column min_c and none max_c: .* as in table_columns.max_c=most", head="file,min_c,most")
    refused(r"bounds_c is one span for all images, and table=.* has one for each", meaning=Meaning(bounds_c=[0.0, 9.0]))


def test_rows_of_no_frame_are_warned_of(tmp_path, caplog):
    spans = spans_of_five()
    source = write_images(tmp_path / "files", {f"f{i}.png": greys(i, ends) for i, ends in enumerate(spans[:3])})
    read_frames(source, Reading(table=write_table(tmp_path, spans), columns=SPAN_COLUMNS))
    assert "2 rows of no frame, such as f3, f4" in caplog.text


def test_files_that_hold_temperatures_need_no_spans(tmp_path):
    """Minima and maxima of such files stand in tables, too, and are what they show."""
    spans = spans_of_five()
    table = write_table(tmp_path, spans)
    kelvin = {f"f{i}.png": np.rint(100 * (truth(i) + 273.15)).astype(np.uint16) for i in range(5)}
    for name, images in (("float", {f"f{i}.tiff": truth(i).astype(np.float32) for i in range(5)}), ("counts", kelvin)):
        found = read_recording(write_images(tmp_path / name, images), Reading(table=table, columns=SPAN_COLUMNS))
        np.testing.assert_allclose(found.frames[2].temperature(), truth(2), atol=6e-3)
        assert any("min_c and max_c are not used, as the files hold temperatures" in note for note in found.notes)


def test_greys_beside_a_table_of_spans_name_it(tmp_path):
    source = write_images(tmp_path, {"f0.png": greys(0, (0, 50))})
    (tmp_path / "temperature_bounds.csv").write_text("file,min_c,max_c\nf0.png,0,50\n")
    notes = read_recording(source).notes
    assert any(
        f"table={tmp_path / 'temperature_bounds.csv'}, with the span of each image, would give them" in n for n in notes
    )
