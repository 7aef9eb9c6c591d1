"""An LPV model and experiments: how it errs, what is known of it, where it begins."""
