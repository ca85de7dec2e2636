"""Commissioning of a rig: characterize its transmission, tune gains, check scripts of experiments."""
