"""The bundled hand as a solid piece of flesh on rigid bones: a reference that skinning is fitted to."""
