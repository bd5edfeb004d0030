"""Modules of the user, imported before anything is looked up by name."""

from __future__ import annotations

import importlib
import importlib.util
import sys
from collections.abc import Sequence
from pathlib import Path

from torchstickcal.errors import CalibrationError


def import_plugins(plugins: Sequence[str]) -> None:
    """Import modules by their dotted names, or from ``.py`` files.

    Raises:
        CalibrationError: if one cannot be imported.
    """
    for plugin in plugins:
        try:
            if plugin.endswith(".py"):
                _import_file(Path(plugin))
            else:
                importlib.import_module(plugin)
        except CalibrationError:
            raise
        except (Exception, SystemExit) as error:
            missing = isinstance(error, ModuleNotFoundError)
            raise CalibrationError(
                "a plugin cannot be imported",
                where=f"--plugin {plugin}",
                got=f"{type(error).__name__}: {error}".rstrip("."),
                expected="a Python module that can be imported, or a .py file",
                remedy="Modules are found if they are installed or in a folder of PYTHONPATH." if missing else "",
            ) from error


def _import_file(path: Path) -> None:
    """Import a file as a module, once in a process."""
    name = f"torchstickcal_plugin_{path.stem}"
    if name in sys.modules and sys.modules[name].__file__ == str(path.resolve()):
        return
    spec = importlib.util.spec_from_file_location(name, path.resolve())
    assert spec is not None
    assert spec.loader is not None
    sys.modules[name] = importlib.util.module_from_spec(spec)
    try:
        spec.loader.exec_module(sys.modules[name])
    except BaseException:
        del sys.modules[name]
        raise
