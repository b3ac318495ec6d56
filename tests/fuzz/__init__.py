"""Fuzzing of the commands: configs, outline files, kills; run by `make fuzz`."""
