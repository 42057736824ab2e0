"""Where the shipped models and scenarios lie: inside the wheel, or beside a checkout's package."""

from pathlib import Path


def _folder(name: str) -> Path:
    package = Path(__file__).resolve().parent.parent
    for base in (package, package.parent):
        if (base / name).is_dir():
            return base / name
    raise FileNotFoundError(f"{name} is missing from this installation of hydrotele")


def models_folder() -> Path:
    """Folder with one folder per shipped machine."""
    return _folder("models")


def scenarios_folder() -> Path:
    """Folder with the shipped scenarios."""
    return _folder("scenarios")
