"""The paper's tables, made on this machine."""
