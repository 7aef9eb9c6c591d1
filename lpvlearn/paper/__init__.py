"""The paper's experiment (Section 3): its run, tables, text and figures."""
