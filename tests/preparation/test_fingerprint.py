"""What was made of the same is known by it."""

from dataclasses import dataclass, field, make_dataclass
from pathlib import Path

from heatsplat.preparation.conditions import InputUncertainty
from heatsplat.preparation.fingerprint import fingerprint


@dataclass(frozen=True)
class Settings:
    scale: float
    path: Path = Path("a")
    load: object = field(default=None, repr=False)


def test_content_counts_and_names_of_classes_do_not():
    renamed = make_dataclass("Renamed", [("scale", float), ("path", Path, Path("a"))])
    assert (
        fingerprint(Settings(1.0), [2]) == fingerprint(renamed(1.0), (2,)) == fingerprint(Settings(1.0, load=len), [2])
    )
    others = [Settings(2.0), Settings(1.0, Path("b")), {"scale": 1.0}, InputUncertainty(), None, "1.0", 1.0]
    assert len({fingerprint(one) for one in [Settings(1.0), *others]}) == 1 + len(others)
    assert fingerprint(InputUncertainty()) != fingerprint(InputUncertainty(air_c=2.0))
