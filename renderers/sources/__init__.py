"""Where shapes come from: ModelNet40 trees and archives, folders of meshes, clouds, scans."""
