"""The views that the methods of a calibration give. What they need is imported when they are asked for."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from torchstickcal.result import VIEWS, Calibration

if TYPE_CHECKING:
    from matplotlib.figure import Figure


def _rig(calibration: Calibration, frame: int | None = None) -> Figure:
    from torchstickcal.show.rig import rig_figure

    return rig_figure(calibration, frame)


def _residuals(calibration: Calibration) -> Figure:
    from torchstickcal.show.pictures import residuals_figure

    return residuals_figure(calibration)


def _stick(calibration: Calibration) -> Figure:
    from torchstickcal.show.stick import stick_figure

    return stick_figure(calibration)


def _summary(calibration: Calibration) -> dict[str, Any]:
    from torchstickcal.show.report import summary

    return summary(calibration)


def _text(calibration: Calibration) -> str:
    from torchstickcal.show.brief import brief_text

    return brief_text(calibration)


def _html(calibration: Calibration) -> str:
    from torchstickcal.show.brief import brief_html

    return brief_html(calibration)


for _name, _view in {
    "rig": _rig,
    "residuals": _residuals,
    "stick": _stick,
    "summary": _summary,
    "text": _text,
    "html": _html,
}.items():
    VIEWS.register(_name, _view)
