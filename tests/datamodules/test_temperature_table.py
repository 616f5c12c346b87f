"""Images of temperatures that were exported as text, in the ways programs write them."""

import numpy as np
import pytest

from heatsplat.contracts import SceneError
from heatsplat.datamodules.formats.temperature_table import read_temperature_table
from heatsplat.datamodules.posed_frames import image_index

VALUES = np.round(20 + 15 * np.random.default_rng(0).random((20, 24)), 2).astype(np.float32)
HEAD = "File;IR_0042.jpg\nEmissivity;0,95\nRefl. temp.;20,0 °C\n\n"


def table(separator: str, comma: bool = False, last: str = "") -> str:
    lines = [separator.join(f"{value:.2f}" for value in row) + last for row in VALUES]
    return "\n".join(lines).replace(".", ",") if comma else "\n".join(lines)


def counted(separator: str) -> str:
    """A first row and a first column that count pixels."""
    rows = [separator.join(["", *map(str, range(1, 25))])]
    return "\n".join(rows + [separator.join([str(i), *(f"{v:.2f}" for v in row)]) for i, row in enumerate(VALUES)])


@pytest.mark.parametrize(
    "data",
    [
        table(",").encode(),
        (HEAD + table(";", comma=True, last=";")).encode("cp1252"),
        ("\ufeff" + table("\t").replace("\n", "\r\n") + "\r\n\r\nend").encode(),
        table("\t", comma=True).encode("utf-16"),
        "\n".join(",".join(f'"{v:.2f}"' for v in row) for row in VALUES).replace(".", ",").encode(),
        ('"' + table(";").replace(";", '";"').replace("\n", '"\n"') + '"').encode(),
        counted(";").encode(),
        counted(",").encode(),
    ],
    ids=[
        "commas",
        "semicolons and decimal commas",
        "tabs and Windows",
        "UTF-16",
        "commas and decimal commas",
        "quotes",
        "counted",
        "counted, commas",
    ],  # fmt: skip
)
def test_a_table_is_read_whatever_separates_it_and_stands_around_it(tmp_path, data):
    (tmp_path / "a.csv").write_bytes(data)
    found = read_temperature_table(tmp_path / "a.csv")
    assert found.dtype == np.float32
    np.testing.assert_array_equal(found, VALUES)


@pytest.mark.parametrize("cell", ["", " ", ">150", "---"])
def test_cells_without_a_number_are_unknown(tmp_path, cell):
    text = table(";").splitlines()
    text[3] = text[3].replace(f";{VALUES[3, 5]:.2f};", f";{cell};", 1)
    (tmp_path / "a.csv").write_text("\n".join(text))
    found = read_temperature_table(tmp_path / "a.csv")
    assert np.argwhere(np.isnan(found)).tolist() == [[3, 5]]


@pytest.mark.parametrize(
    "text",
    [
        "",
        "time,air_c\n0,12\n60,13\n",
        "\n".join(["1,2,3"] * 40),
        "\n".join(table(",").splitlines()[:9]),
        "\n".join(f"{i}:00,{row}" for i, row in enumerate(table(",").splitlines())),
    ],  # fmt: skip
)
def test_what_is_no_image_is_none(tmp_path, text):
    (tmp_path / "a.csv").write_text(text)
    assert read_temperature_table(tmp_path / "a.csv") is None


def test_fahrenheit_several_images_and_what_cannot_be_read_are_refused_by_name(tmp_path):
    file = tmp_path / "a.csv"
    file.write_text("Unit: °F\n" + table(","), encoding="utf-8")
    with pytest.raises(SceneError, match=r"a.csv says that its temperatures are °F: export them in °C"):
        read_temperature_table(file)
    file.write_text(table(",") + "\nFrame 2\n" + table(","))
    with pytest.raises(SceneError, match="a.csv holds several images as tables: export each"):
        read_temperature_table(file)
    with pytest.raises(SceneError, match="b.csv cannot be read: No such file"):
        read_temperature_table(tmp_path / "b.csv")


def test_a_scene_of_tables_says_how_it_becomes_one_of_images(tmp_path):
    (tmp_path / "images").mkdir()
    (tmp_path / "images" / "IR_0001.csv").write_text(table(";"))
    with pytest.raises(
        SceneError, match=r"holds no image, but tables such as IR_0001.csv: python src/prepare.py source=.*poses.model="
    ):
        image_index(tmp_path, "images", "data.images")
