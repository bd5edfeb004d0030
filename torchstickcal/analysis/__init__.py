"""Analysis of swings: joint angles, stick kinematics, phases and repeated swings, each with its standard deviation.

Example:
    >>> from torchstickcal.analysis import ANGLES, SPORTS
    >>> ANGLES["left_knee_flexion"].definition
    'Angle between the long axes of thigh and shank; 0 is a straight leg.'
    >>> SPORTS["hockey"].rule
    'the blade is lowest'
"""

from torchstickcal.analysis.analyse import Analysis, Curve, Figure, Repeated, Swing, analyse
from torchstickcal.analysis.angles import ANGLES, Angle
from torchstickcal.analysis.phases import EVENTS, RULES, SPORTS
from torchstickcal.analysis.repeats import multiple_correlation

__all__ = [
    "ANGLES",
    "EVENTS",
    "RULES",
    "SPORTS",
    "Analysis",
    "Angle",
    "Curve",
    "Figure",
    "Repeated",
    "Swing",
    "analyse",
    "multiple_correlation",
]
