"""The paper's experiments: its comparison methods, Fig. 6, Fig. 7 and Table 2."""
