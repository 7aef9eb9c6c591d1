"""The black boxes of the operating points: step 3, and what points tell together."""
