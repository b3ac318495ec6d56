"""Fuzzing of the commands: configs, outline files, environments, kills; run by `make fuzz`."""
