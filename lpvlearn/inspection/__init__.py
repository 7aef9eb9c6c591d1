"""Pictures of models, simulations and parameters, in scikit-learn's Display style.

Each class has class methods ``from_...`` that draw at once and return the display, and
``plot`` to draw it again. Matplotlib is imported when something is drawn, not before.
"""

from ._bode import BodeDisplay
from ._error import ErrorDisplay
from ._parameters import ParameterDisplay
from ._poles import PoleDisplay
from ._simulation import SimulationDisplay
from ._singular_values import SingularValueDisplay

__all__ = [
    "BodeDisplay",
    "ErrorDisplay",
    "ParameterDisplay",
    "PoleDisplay",
    "SimulationDisplay",
    "SingularValueDisplay",
]
