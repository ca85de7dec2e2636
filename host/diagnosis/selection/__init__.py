"""Which effects are missing: screening, search, indistinguishable models, localization."""
