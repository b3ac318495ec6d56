"""`python -m rootsopt.new FILE`: write a config from a catalogue sheet."""

from rootsopt.commands.table import new

new.begin(__name__)
