"""Settings of the whole suite: the same examples in every run, and no deadline on the wall clock."""

from hypothesis import settings

settings.register_profile("seldinger", deadline=None, derandomize=True, print_blob=False)
settings.load_profile("seldinger")
