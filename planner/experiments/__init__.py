"""The paper's experiments: block sizing, scenario, tables and figures (paper 4)."""
