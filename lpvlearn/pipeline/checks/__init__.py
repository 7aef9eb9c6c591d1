"""What an LPV model is asked once it is there: stability, errors, bands."""
