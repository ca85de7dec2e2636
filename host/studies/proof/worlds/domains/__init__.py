"""World `domains`: recordings as other laboratories make them; one file of data sets for each field."""
