"""Ground floor: the words that every part speaks - serial frames and zenoh topics. Imports no other room."""
