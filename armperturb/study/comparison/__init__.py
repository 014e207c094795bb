"""How a study compares with the published one."""
