"""Other models of the same samples: what else moved the outputs, if it matters."""
