"""Files for autopilots and for flying simulations, which come with the package."""

from __future__ import annotations

from importlib import metadata
from pathlib import Path

#: Where they are in a checkout.
_FOLDERS = ("firmware_params", "sitl")
_ENDINGS = (".parm", ".params", ".lua", ".yaml")


def shipped(name: str) -> Path | None:
    """A file by its name, in a checkout or among the files of the installed package; None: there is none."""
    if not name.endswith(_ENDINGS) or Path(name).name != name:
        return None
    root = Path(__file__).parents[2]
    for folder in _FOLDERS:
        if (path := root / folder / name).is_file():
            return path
    try:
        files = metadata.files("rass-mav") or ()
    except metadata.PackageNotFoundError:
        return None
    return next((Path(str(file.locate())) for file in files if file.name == name and "share" in file.parts), None)


def shipped_or(path: str) -> str:
    """The same path, if there is such a file or it has a folder; otherwise that of the file that ships under this
    name."""
    found = None if Path(path).exists() else shipped(path)
    return path if found is None else str(found)
