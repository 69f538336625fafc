"""What the package needs of the machine and of Python: files, settings, checks, signals, memory,
LLVM.
"""
