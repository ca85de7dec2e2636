"""Top floor: mechanics, estimation, identification, diagnosis, recording and the command line. May import all rooms."""
