"""The command line `lasercal`: one module for each command, nothing heavy until one is run."""
