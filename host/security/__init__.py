"""Keys and certificates for readers and commanders on other machines."""
