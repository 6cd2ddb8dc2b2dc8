"""Wave spectra, realised sea surfaces and their meshes."""
