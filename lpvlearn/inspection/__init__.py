"""Pictures of models, simulations and parameters, in scikit-learn's Display style.

Each class has class methods ``from_...`` that draw at once and return the display, and
``plot`` to draw it again. Matplotlib is imported when something is drawn, not before.
"""

from .bode import BodeDisplay
from .error import ErrorDisplay
from .overview import plot_overview
from .parameters import ParameterDisplay
from .poles import PoleDisplay
from .residuals import ResidualDisplay
from .simulation import SimulationDisplay
from .singular_values import SingularValueDisplay
from .uncertainty import UncertaintyDisplay

__all__ = [
    "BodeDisplay",
    "ErrorDisplay",
    "ParameterDisplay",
    "PoleDisplay",
    "ResidualDisplay",
    "SimulationDisplay",
    "SingularValueDisplay",
    "UncertaintyDisplay",
    "plot_overview",
]
