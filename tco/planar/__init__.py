"""Planes that the depths of all views show, and which pixels are on one.

A plain wall gives neither the network nor the comparison of colours anything to hold on to, so that its depth
is right where something is on it and waves or leans elsewhere. If it is flat, the part that is known tells
where the rest is. Three steps, on depths after the consensus:

1. ``fit.find``: planes are drawn from single pixels with their normals, of all views alike. One counts by the
   confidence of the pixels near it, and near is what their confidence allows. What the best one explains is
   set aside (sequential RANSAC). Where most surfaces face along three directions at right angles, as
   ``frame.frame_of`` finds, planes are put up along these, too, at the rims of what is unsure
   (``hinges.hinged``).
2. ``label.labelled``: each pixel takes a plane or keeps its depth, by the energy of ``_kernels.py``: a plane
   costs where it departs from a depth that is sure, where the plane itself is unsure, and where colours are
   not those seen on it; depths that are kept cost by their steps to the neighbours, less across edges of the
   picture. What faces along none of the three directions costs, too.
3. ``fit.refit``: a plane is fitted again to the pixels that took it, with the covariance of its parameters,
   so that it is not believed far from where it was seen; one nearly along a direction is expected to be along
   it. Then 2 again (PEARL: Isack and Boykov, Energy-based
   geometric multi-model fitting, IJCV 2012).

Planes among other surfaces: Gallup et al., Piecewise planar and non-planar stereo for urban scene
reconstruction, CVPR 2010. Everything is on the CPU, in numpy.
"""
