"""The commands `rootsopt COMMAND`, one file each."""
