"""What is declared: the parameters of all plugins."""
