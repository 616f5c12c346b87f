"""Which folders are which packages: src/, and the top-level conf/, datamodules/ and preparation/ under heatsplat's own name."""

from setuptools import find_namespace_packages, setup

FOLDERS = {
    "": "src",
    "heatsplat.conf": "conf",
    "heatsplat.datamodules": "datamodules",
    "heatsplat.preparation": "preparation",
}


def packages_of(package: str, folder: str) -> list[str]:
    inner = find_namespace_packages(folder, exclude=["*__pycache__", "*.egg-info"])
    return [package, *(f"{package}.{name}" for name in inner)] if package else inner


setup(package_dir=FOLDERS, packages=[name for item in FOLDERS.items() for name in packages_of(*item)])
