"""Any step at several operating points at a time, and what a folder keeps of it."""
