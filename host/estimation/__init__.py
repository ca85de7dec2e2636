"""Force estimation from measured poses."""
