"""How good a reconstruction is: the figures of the field, each as its source defines it.

numpy in, numbers out; every module names the paper and the public code that its definitions follow.
"""
