"""The command line: one small file per command. Whatever takes long to import is imported inside the command."""
