"""What several tests of loaders write."""

import pytest


@pytest.fixture
def table(tmp_path):
    """Writes lines as a table of the weather and returns its path."""

    def write(*lines: str):
        path = tmp_path / "weather.csv"
        path.write_text("\n".join(lines) + "\n", encoding="utf-8")
        return path

    return write
