"""Curves of the points that a table names, in the coordinates of the data set or by the pixel in which they lie."""

from dataclasses import replace
from types import SimpleNamespace

import pytest
import torch
from fake_run import FakeModule, evaluate, fit, trainer, wall

from heatsplat.callbacks.asked_points import asked_points
from heatsplat.callbacks.probes import TemperatureCurves
from heatsplat.contracts import SceneError
from heatsplat.io.tables import read_csv


class Deep(FakeModule):
    """Knows where the wall and its cameras are."""

    cameras = SimpleNamespace(of=lambda frame: frame.camera)

    def surface(self, frame):
        return torch.full((frame.camera.height, frame.camera.width), 4.0)


def asked(tmp_path, table, scene=None):
    """The tables of curves and of places of a run that was asked for the points of a table."""
    (tmp_path / "points.csv").write_text(table)
    module = Deep(wall(truth=False) if scene is None else scene, tmp_path)
    curves = TemperatureCurves(times=3, points=str(tmp_path / "points.csv"))
    evaluate(module, trainer(tmp_path, [curves], logger=False))
    return read_csv(tmp_path / "renders" / "probes.csv"), read_csv(tmp_path / "renders" / "probe_positions.csv")


def test_curves_are_those_of_the_points_of_a_table(tmp_path, caplog):
    far = {"origin": [599456.5, 5695495.25, 0.0]}  # taken off coordinates of UTM
    table = "name,x,y,z\nstove,599456,5695495.25,4\nbehind,599456.5,5695495.25,-9\nwindow,599457,5695495.45,4\n"
    curves, places = asked(tmp_path, table, replace(wall(truth=False), notes=far))
    assert list(curves[0]) == ["time_s", "beyond_record_s", "stove", "window"]
    assert [row["x"] for row in places] == [599456.0, 599457.0]
    assert "callbacks.probes.points: no camera sees behind, of which there is no curve" in caplog.text


def test_curves_of_pixels_are_those_that_their_frame_shows_there(tmp_path):
    frame = wall().train.frames[3]
    curves, (left, right) = asked(tmp_path, f"view,row,column\n{frame.name},20,5\n{frame.name},20,50\n")
    found = [(place["name"], place["view"], place["row"], place["column"]) for place in (left, right)]
    assert found == [("point 1", frame.name, 20, 5), ("point 2", frame.name, 20, 50)]
    pixel, depth = frame.camera.project(torch.tensor([[right[axis] for axis in "xyz"]]))
    assert pixel[0].tolist() == pytest.approx([50.5, 20.5], abs=1e-3) and depth.item() == pytest.approx(4.0, abs=1e-5)
    again, _ = asked(tmp_path, (tmp_path / "renders" / "probe_positions.csv").read_text())
    assert [row["point 1"] for row in again] == pytest.approx([row["point 1"] for row in curves])


@pytest.mark.parametrize(
    ("table", "message"),
    [
        ("name,x,y\na,1,2\n", "points.csv has the columns name, x, y; x, y, z or view, row, column are needed"),
        ("x,y,z\n", "points.csv has no point"),
        ("x,y,z\n1,2,warm\n", "points.csv, row 1: z is 'warm', a number is needed"),
        ("x,y,z\n1,2,\n", "points.csv, row 1: z is '', a number is needed"),
        ("x,y,z\n1,2,1_5\n", "points.csv, row 1: z is '1_5', a number is needed"),
        ("x,y,z\n1,2,nan\n", "points.csv, row 1: z is 'nan', a number is needed"),
        ("x,y,z\n1,2,3,4\n", "points.csv, row 1: 4 cells for 3 columns"),
        ("name,x,y,z\na,1,2,3\na,1,2,4\n", "points.csv has two points called 'a'"),
        (
            "view,row,column\nnone.png,1,2\n",
            "row 1: 'none.png' is no frame of scene 'wall'; names look like train/000.png",
        ),
        (
            "view,row,column\ntrain/000.png,40,2\n",
            "row 40, column 2 lies outside of train/000.png, which has 40 rows and 56",
        ),
    ],
)
def test_what_is_no_table_of_points_is_refused_before_the_first_step(tmp_path, table, message):
    (tmp_path / "points.csv").write_text(table)
    module, curves = FakeModule(wall(), tmp_path), TemperatureCurves(points=str(tmp_path / "points.csv"))
    with pytest.raises(SceneError, match=message):
        fit(module, trainer(tmp_path, [curves], steps=4, every=4, logger=False))
    assert module.value.item() == pytest.approx(0.9)


def test_a_table_that_is_not_there_and_a_method_without_time_are_told(tmp_path, caplog):
    module = FakeModule(wall(), tmp_path)
    with pytest.raises(SceneError, match="callbacks.probes.points=none.csv cannot be read"):
        evaluate(module, trainer(tmp_path, [TemperatureCurves(points="none.csv")], logger=False))
    (tmp_path / "points.csv").write_text("x,y,z\n0,0,4\n")
    module.thermal.needs = frozenset()
    evaluate(module, trainer(tmp_path, [TemperatureCurves(points=str(tmp_path / "points.csv"))], logger=False))
    assert "a method or scene without time has no curves" in caplog.text and not (tmp_path / "renders").exists()


def test_names_of_digits_stay_as_they_are(tmp_path):
    (tmp_path / "points.csv").write_text("name,x,y,z\n7,0,0,4\n2.5,0,0,4\n,0,0,4\n")
    assert [one.name for one in asked_points(tmp_path / "points.csv", wall())] == ["7", "2.5", "point 3"]


@pytest.mark.parametrize("encoding", ["utf-16", "cp1252", "utf-8-sig", "utf-8"])
def test_tables_in_any_encoding_of_excel_are_read(tmp_path, encoding):
    text = "sep=;\r\nname;x;y;z\r\n\r\nTür Süd;1,5;0;4\r\n#2;1;0;4\r\n"
    (tmp_path / "points.csv").write_bytes(text.encode(encoding))
    found = asked_points(tmp_path / "points.csv", wall())
    assert [(one.name, one.point[0].item()) for one in found] == [("Tür Süd", 1.5), ("#2", 1.0)]


def test_what_is_no_text_is_told_with_a_remedy(tmp_path):
    for data in (b"PK\x03\x04\x81\x8d\xff", b"\xff\xfea"):
        (tmp_path / "points.csv").write_bytes(data)
        with pytest.raises(SceneError, match="points=.*points.csv cannot be read: it is no text; save it as UTF-8"):
            asked_points(tmp_path / "points.csv", wall())


@pytest.mark.parametrize("apart", [";", "\t"])
def test_tables_of_other_programs_are_read(tmp_path, apart):
    lines = ["name;x;y;z", "stove;0,5;-1,25;4", "", "oven ;1;2;3"]
    (tmp_path / "points.csv").write_text("\n".join(lines).replace(";", apart), encoding="utf-8-sig")
    found = asked_points(tmp_path / "points.csv", wall())
    assert [(one.name, one.point.tolist()) for one in found] == [
        ("stove", [0.5, -1.25, 4.0]),
        ("oven", [1.0, 2.0, 3.0]),
    ]


def test_a_pixel_without_a_surface_has_no_place(tmp_path):
    frame = wall().train.frames[0]
    (tmp_path / "points.csv").write_text(f"view,row,column\n{frame.name},20,5\n")
    (one,) = asked_points(tmp_path / "points.csv", wall())
    assert one.placed(lambda frame: torch.full((40, 56), torch.inf), lambda frame: frame.camera) is None
