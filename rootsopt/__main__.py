"""`python -m rootsopt COMMAND ...`: all commands by their names."""

from rootsopt.commands.console import console

if __name__ == "__main__":
    console()
