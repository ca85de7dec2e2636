"""Independent reference models, and the scripts that make reference values with them."""
