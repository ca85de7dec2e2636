"""Parameter estimation: noise, free-run fits, evidence and confidence intervals."""
