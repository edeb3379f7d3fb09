"""Small trainers that reproduce the object names, signatures and edit order of the official repositories, in own code.

Each module has a `GaussianModel` and a bare `training`; the tests apply the diff of the page in docs/attach to its
source and run both on the CPU.
"""
