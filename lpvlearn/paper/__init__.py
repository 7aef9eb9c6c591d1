"""The paper's experiment (Section 3): its run, tables, text and figures."""

from .experiment import PaperExperiment, run_paper_experiment
from .figures import draw_balanced, draw_bode, draw_parameters, save_figures
from .text import tables_text

__all__ = [
    "PaperExperiment",
    "draw_balanced",
    "draw_bode",
    "draw_parameters",
    "run_paper_experiment",
    "save_figures",
    "tables_text",
]
