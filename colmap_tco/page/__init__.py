"""The result as one page for a browser: :mod:`colmap_tco.page.content` gathers, :mod:`.write` writes.

``web/`` holds the sources of the page; ``node build.mjs`` bundles them into ``built/page.html``, which is
committed and installed, so that no run needs node or the network. It names the hash of its sources, by which
a test sees that it is current.
"""
