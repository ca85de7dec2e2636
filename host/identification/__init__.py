"""Identification: from recorded shapes under known loads to a catheter's parameters."""
