"""`python -m rootsopt.new FILE`: write a config from a catalogue sheet."""

from rootsopt.commands.door import leave
from rootsopt.commands.table import new

main = new.main

if __name__ == "__main__":
    leave(main())
