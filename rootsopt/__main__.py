"""`python -m rootsopt COMMAND ...`: run a command by its name."""

from rootsopt.commands.console import console

if __name__ == "__main__":
    console()
