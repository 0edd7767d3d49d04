"""The bundled hand as a solid piece of flesh on rigid bones: a truth that skinning can be measured against."""
