"""What is compared: the nominal model's file, recordings, ports, candidate effects and their operators."""
