"""Gray-box structures: system matrices as functions of named parameters."""

from .structure import GrayBoxStructure

__all__ = ["GrayBoxStructure"]
