"""Rewrite the reference data files next to this script: python datasets/regenerate.py

The files follow from a seed, so that running this leaves them as they
are, byte for byte.
"""

from pathlib import Path

from lpvlearn.datasets._reference import write_reference

if __name__ == "__main__":
    write_reference(Path(__file__).resolve().parent)
