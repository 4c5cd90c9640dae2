//! Whose signature on a receiver's certificate is believed: the web's authorities, and those of the site file.

use std::path::Path;
use std::sync::Arc;

use lettre::transport::smtp::client::{Certificate, TlsParameters};
use tokio_rustls::TlsConnector;
use tokio_rustls::rustls::pki_types::CertificateDer;
use tokio_rustls::rustls::pki_types::pem::PemObject as _;
use tokio_rustls::rustls::{ClientConfig, RootCertStore};

use crate::config::Violation;

/// Authorities beside the web's.
#[derive(Default)]
pub(in crate::site) struct Authorities(Vec<CertificateDer<'static>>);

impl Authorities {
    /// From a PEM file with one certificate or several.
    ///
    /// # Errors
    /// It cannot be read, or holds no certificate that can be an authority's.
    pub fn read(path: &Path) -> Result<Self, Violation> {
        let refused = |why: String| Violation {
            key: "alerts.certificates_file".to_owned(),
            message: format!("is {}, which {why}", path.display()),
        };
        let certificates: Vec<_> = CertificateDer::pem_file_iter(path)
            .and_then(Iterator::collect)
            .map_err(|error| refused(format!("cannot be read: {error}")))?;
        if certificates.is_empty() {
            return Err(refused("holds no certificate in PEM".to_owned()));
        }
        let mut roots = RootCertStore::empty();
        for certificate in &certificates {
            roots
                .add(certificate.clone())
                .map_err(|error| refused(format!("holds one that is no authority's: {error}")))?;
        }
        Ok(Self(certificates))
    }

    /// For HTTPS.
    pub fn connector(&self) -> Result<TlsConnector, String> {
        let mut roots = RootCertStore { roots: webpki_roots::TLS_SERVER_ROOTS.to_vec() };
        roots.add_parsable_certificates(self.0.iter().cloned());
        let provider = Arc::new(tokio_rustls::rustls::crypto::ring::default_provider());
        let config = ClientConfig::builder_with_provider(provider)
            .with_safe_default_protocol_versions()
            .map_err(|error| error.to_string())?
            .with_root_certificates(roots)
            .with_no_client_auth();
        Ok(TlsConnector::from(Arc::new(config)))
    }

    /// For SMTP with a server of that name.
    pub fn mail(&self, host: &str) -> Result<TlsParameters, String> {
        let mut parameters = TlsParameters::builder(host.to_owned());
        for certificate in &self.0 {
            let certificate =
                Certificate::from_der(certificate.to_vec()).map_err(|error| error.to_string())?;
            parameters = parameters.add_root_certificate(certificate);
        }
        parameters.build().map_err(|error| error.to_string())
    }
}
